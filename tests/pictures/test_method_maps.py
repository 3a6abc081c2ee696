"""Known normals and errors have known colours at known places, in every size of picture."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import decode_rgb
from splinecli.maths.normals import unit
from splinecli.pictures.maps import TOP_DEG, colour_errors
from splinecli.pictures.plots import method_maps


def draw(
    height: int, width: int, methods: list[str], error_deg: float = 12.0, title: str = "title"
) -> NDArray[np.uint8]:
    """A mask that leaves a margin of two pixels free, ground truth (0, 0, 1), estimates along (1, 0, 1)."""
    mask = np.zeros((height, width), bool)
    mask[2:-2, 2:-2] = True
    truth = np.zeros((height, width, 3), np.float32)
    truth[mask] = (0, 0, 1)
    estimate = np.full_like(truth, np.nan)
    estimate[mask] = unit(np.array([1.0, 0.0, 1.0]))
    errors = np.where(mask, np.float32(error_deg), np.float32(np.nan))
    estimates, error_maps = dict.fromkeys(methods, estimate), dict.fromkeys(methods, errors)
    return decode_rgb(method_maps(truth, mask, estimates, error_maps, title=title))


def places_of(colour: tuple[int, ...], picture: NDArray[np.uint8]) -> list[tuple[int, int, int, int]]:
    """Boxes (top, left, height, width) of the large connected areas of a colour, from the left."""
    _, _, boxes, _ = cv2.connectedComponentsWithStats((picture == colour).all(axis=2).astype(np.uint8))
    return sorted((int(y), int(x), int(h), int(w)) for x, y, w, h, area in boxes[1:] if area > 500)


BLUE = (128, 128, 255)  # of (0, 0, 1)
TILTED = (218, 128, 218)  # of (1, 0, 1) / sqrt 2


def error_colour(error_deg: float) -> tuple[int, ...]:
    return tuple(int(value) for value in colour_errors(np.array([[error_deg]]))[0, 0])


@pytest.mark.parametrize("n_methods", [1, 2, 9])
@pytest.mark.parametrize(("height", "width"), [(10, 10), (300, 200), (40, 120), (120, 40)])
def test_colours_stand_where_they_belong(height: int, width: int, n_methods: int) -> None:
    picture = draw(height, width, [f"method {i}" for i in range(n_methods)])
    [truth] = places_of(BLUE, picture)
    normals, errors = places_of(TILTED, picture), places_of(error_colour(12), picture)
    assert len(normals) == len(errors) == n_methods
    # Cut to the mask's box and enlarged by a whole factor, all alike.
    factor = truth[2] // (height - 4)
    assert {place[2:] for place in (truth, *normals, *errors)} == {(factor * (height - 4), factor * (width - 4))}
    # One row of normals, ground truth first; each method's errors below its normals.
    assert {place[0] for place in normals} == {truth[0]}
    assert truth[1] < normals[0][1]
    assert [place[1] for place in errors] == [place[1] for place in normals]
    assert errors[0][0] >= truth[0] + truth[2]


def test_the_frame_is_not_turned() -> None:
    mask = np.ones((100, 100), bool)
    truth = np.zeros((100, 100, 3))
    truth[:50], truth[50:] = (0, 0, 1), unit(np.array([1.0, 0.0, 1.0]))
    errors = np.zeros((100, 100))
    errors[:, 50:] = 30
    picture = decode_rgb(method_maps(truth, mask, {"a": truth}, {"a": errors}, title="t"))
    assert [p[0] for p in places_of(BLUE, picture)] < [p[0] for p in places_of(TILTED, picture)]
    right = [place for place in places_of(error_colour(30), picture) if place[2] > 90]
    left = [place for place in places_of(error_colour(0), picture) if place[2] > 90]
    assert left[0][1] + left[0][3] == right[0][1]


def test_nothing_is_cut_at_the_edges_and_the_bar_runs_over_the_whole_scale() -> None:
    picture = draw(300, 300, ["ls"])
    for error_deg in (0.0, TOP_DEG / 2, TOP_DEG):
        assert (picture == error_colour(error_deg)).all(axis=2).sum() >= 10
    long = "a capture with quite a long name, 10 lights, draw 1 of 10, seed 0, light noise of 2 degrees $x$"
    for methods in (["ls"], ["a method with a long name", "b"]):
        picture = draw(20, 30, methods, title=long)
        for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
            assert (edge == 255).all()
