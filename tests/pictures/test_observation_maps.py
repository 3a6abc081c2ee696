"""A cell has its colour at its place in the figure; empty cells are gray."""

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import decode_rgb
from splinecli.pictures.plots import observation_map_figure

SIZE = 8
YELLOW, VIOLET, GRAY = (253, 231, 36), (68, 1, 84), (217, 217, 217)  # viridis' ends; 0.85 of 255


@cache
def draw(
    n_pixels: int, *, with_truth: bool = True, with_dense: bool = True, named: bool = True, grid: str = "even"
) -> NDArray[np.uint8]:
    """RGB (H, W, 3). Sparse maps have a one at row 1, column 5; dense maps are zeros; the truth is empty."""
    sparse = np.full((n_pixels, SIZE, SIZE), np.nan, np.float32)
    sparse[:, 1, 5] = 1
    png = observation_map_figure(
        sparse,
        np.zeros_like(sparse) if with_dense else None,
        np.full_like(sparse, np.nan) if with_truth else None,
        pixels=np.array([[12, 34]] * n_pixels) if named else None,
        error_deg=np.full(n_pixels, 3.25),
        title="$cat$, 10 lights" if named else "",
        grid=grid,  # type: ignore[arg-type]
    )
    return decode_rgb(png)


def boxes(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> list[NDArray[np.int32]]:
    """Left, top, width, height of the areas of a colour that are as large as a cell, downwards."""
    same = (np.abs(picture.astype(int) - colour).max(axis=2) <= 2).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(same)
    return sorted((box[:4] for box in stats[1:] if box[4] > 400), key=lambda box: (box[1], box[0]))


@pytest.mark.parametrize("n_pixels", [1, 4])
def test_cells_stand_where_they_are(n_pixels: int) -> None:
    picture = draw(n_pixels)
    # Frames around a map, from its empty corner beside the circle.
    dense = [box for box in boxes(picture, VIOLET) if min(box[2:]) > 100]
    assert len(dense) == n_pixels
    for cell, whole in zip(boxes(picture, YELLOW), dense, strict=True):
        side = whole[2] / SIZE
        assert cell[2:] == pytest.approx([side, side], abs=2)
        assert cell[1] - whole[1] == pytest.approx(side, abs=3)  # row 1
        assert cell[0] < whole[0]  # the sparse map is left of the dense one


def test_empty_cells_are_gray_and_the_truth_may_be_missing() -> None:
    with_truth, without = draw(2), draw(2, with_truth=False)
    assert with_truth.shape[1] > without.shape[1]
    gray = [(np.abs(p.astype(int) - GRAY).max(axis=2) <= 1).sum() for p in (with_truth, without)]
    assert gray[0] > 1.8 * gray[1]


def test_a_training_run_leaves_out_the_title_and_the_places_and_perhaps_the_dense_map() -> None:
    whole, unnamed, without = draw(2), draw(2, named=False), draw(2, named=False, with_dense=False)
    assert len(boxes(unnamed, YELLOW)) == len(boxes(without, YELLOW)) == 2
    assert boxes(unnamed, YELLOW)[0][1] < boxes(whole, YELLOW)[0][1]  # no title above
    assert without.shape[1] < unnamed.shape[1]
    assert not [box for box in boxes(without, VIOLET) if box[2] > 100]
