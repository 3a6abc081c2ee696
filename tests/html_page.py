"""A parser for the tests of the HTML pages, and the report and normals of a ball to show."""

import json
from html.parser import HTMLParser

import numpy as np

from scenes import on_sphere, square_grid

VOID = {"meta", "link", "img", "input", "br", "hr"}


class HtmlPage(HTMLParser):
    """The tags with their attributes, and the text by tag. An end tag that does not match its start
    tag fails.
    """

    def __init__(self, html):
        super().__init__()
        self.open, self.tags, self.text = [], [], {}
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if data.strip() and self.open:
            self.text.setdefault(self.open[-1], []).append(" ".join(data.split()))


REPORT = json.loads("""{
"capture": "ball", "method": "spline-net",
"weights": {"name": "blobby-7",
            "sha256": "0123456789ab0123456789ab0123456789ab0123456789ab0123456789ab"},
"n_lights": 10, "light_indices": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9],
"n_pixels": 45200, "image_size": [296, 321],
"device": "cpu", "precision": "float32", "peak_memory_mib": 86, "version": "0.1.0",
"warnings": [],
"seconds": {"read": 0.6, "estimate": 0.008, "surface": 0.0, "total": 0.608},
"expected_under_5": 0.8123, "capture_judged": true,
"angular_error_deg":
    {"mean": 9.063, "median": 6.24, "p90": 18.1, "under_5": 0.3725, "under_10": 0.75}
}""")
SIDE = 256
"""Pixels of the ball."""


def ball(side=SIDE):
    """Normals (side, side, 3) and mask of a sphere that nearly fills the picture."""
    x, y = square_grid(side, (side - 1) / side / 0.94)
    mask = x**2 + y**2 < 1
    return np.float32(on_sphere(x, y) * mask[..., None]), mask


def light_at(x, y):
    return on_sphere(x, y)
