"""A parser for the tests of the HTML pages, and the report and normals of a ball to show."""

from html.parser import HTMLParser
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes import square_grid

VOID = {"meta", "link", "img", "input", "br", "hr"}


class HtmlPage(HTMLParser):
    """The tags with their attributes, and the text by tag. An end tag that does not match its start
    tag fails.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, list[str]] = {}
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip() and self.open:
            self.text.setdefault(self.open[-1], []).append(" ".join(data.split()))


REPORT: dict[str, Any] = {
    "capture": "ball",
    "method": "spline-net",
    "weights": {"name": "blobby-7", "sha256": "0123456789ab" * 5},
    "n_lights": 10,
    "light_indices": list(range(10)),
    "n_pixels": 45200,
    "image_size": [296, 321],
    "device": "cpu",
    "precision": "float32",
    "peak_memory_mib": 86,
    "version": "0.1.0",
    "warnings": [],
    "seconds": {"read": 0.6, "estimate": 0.008, "surface": 0.0, "total": 0.608},
    "expected_under_5": 0.8123,
    "capture_judged": True,
    "angular_error_deg": {
        "mean": 9.063,
        "median": 6.24,
        "p90": 18.1,
        "under_5": 0.3725,
        "under_10": 0.75,
    },
}
SIDE = 256
"""Pixels of the ball."""


def ball(side: int = SIDE) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Normals (side, side, 3) and mask of a sphere that nearly fills the picture."""
    x, y = square_grid(side, (side - 1) / side / 0.94)
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 0))
    return (np.stack((x, y, z), axis=2) * mask[..., None]).astype(np.float32), mask


def light_at(x: float, y: float) -> NDArray[np.float64]:
    return np.array((x, y, np.sqrt(1 - x * x - y * y)))
