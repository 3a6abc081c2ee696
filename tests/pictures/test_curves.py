"""Curves of plain points: every method is drawn, and axes accept what evaluations give them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splinecli.pictures.curves import Panel, Point, error_curves
from splinecli.pictures.plotting import method_styles

POINTS = (Point(4, 6.0, 0.5), Point(10, 4.0, 0.2), Point(96, 3.0, 0.0))
TICKS = {4: "4", 10: "10", 96: "96\n(all)"}


def colours_of(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_every_method_has_its_colour(logarithmic: bool) -> None:
    higher = [point._replace(mae_deg=point.mae_deg + 2) for point in POINTS]
    panel = Panel("ball", TICKS, {("ls", ""): POINTS, ("spline-net", ""): higher})
    picture = colours_of(error_curves([panel], label="number of lights", logarithmic=logarithmic))
    for style in method_styles(["ls", "spline-net"]).values():
        rgb = [int(style.colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(picture - rgb).max(axis=2) <= 2).mean() > 0.001


def test_the_order_of_the_ticks_does_not_matter() -> None:
    backwards = dict(reversed(TICKS.items()))
    pictures = [
        error_curves([Panel("ball", ticks, {("ls", ""): POINTS})], label="lights")
        for ticks in (TICKS, backwards)
    ]
    assert pictures[0] == pictures[1]
