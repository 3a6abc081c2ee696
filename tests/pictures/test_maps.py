"""Known values and errors have known colours; maps of every size are legible; PNG files keep every value."""

import cv2
import numpy as np
import pytest

from splinecli.errors import OutputError
from splinecli.pictures.maps import (
    PREVIEW_LIGHT,
    TOP_DEG,
    albedo_picture,
    colour_errors,
    encode_png,
    preview_picture,
)
from splinecli.pictures.plots import error_map_picture


def test_white_is_the_brightest_hundredth_of_the_mask():
    albedo = np.full((20, 20, 3), (0.4, 0.2, 0.0), np.float32)
    mask = np.ones((20, 20), bool)
    mask[0] = False
    albedo[0] = 100  # outside the mask: no influence
    albedo[1, :2] = 50  # two of 380 pixels, less than a hundredth
    picture = albedo_picture(albedo, mask)
    assert picture.dtype == np.uint8
    assert picture[10, 10].tolist() == [255, 188, 0]  # sRGB of 1, 1/2 and 0 (IEC 61966-2-1)
    assert (picture[1, 0] == 255).all()


def test_the_preview_is_brightest_where_the_surface_faces_the_light():
    light = np.array(PREVIEW_LIGHT) / np.linalg.norm(PREVIEW_LIGHT)
    across = np.cross(light, (0, 0, 1)) / np.linalg.norm(np.cross(light, (0, 0, 1)))
    half = (light + np.sqrt(3) * across) / 2  # 60 degrees from the light
    normals = np.array([[light, half, -light, light]], np.float32)
    picture = preview_picture(normals, np.array([[True, True, True, False]]))
    assert picture[0].tolist() == [[255] * 3, [188] * 3, [0] * 3, [0] * 3]


def test_png_keeps_every_value(monkeypatch):
    for dtype, shape in ((np.uint8, (7, 5)), (np.uint16, (7, 5)), (np.uint8, (7, 5, 3)), (np.uint16, (7, 5, 3))):
        picture = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
        stored = cv2.imdecode(np.frombuffer(encode_png(picture), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(stored if picture.ndim == 2 else stored[..., ::-1], picture)
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, np.empty(0, np.uint8)))
    with pytest.raises(OutputError, match="cannot be encoded as PNG"):
        encode_png(np.zeros((2, 2), np.uint8))


# The ends and the middle of viridis as its authors publish it (bids.github.io/colormap), times 255.
VIOLET, TEAL, YELLOW = (68, 1, 84), (33, 145, 140), (253, 231, 37)
WHITE = (255, 255, 255)


def test_known_errors_have_known_colours() -> None:
    errors = np.array([[0, 15, 30, 180, np.nan]], np.float32)
    colours = colour_errors(errors).astype(int)
    wanted = np.array([[VIOLET, TEAL, YELLOW, YELLOW, WHITE]])
    assert np.abs(colours - wanted).max() <= 2  # OpenCV's table is rounded in its own way
    assert (colours[0, 4] == 255).all()


def test_a_small_map_is_enlarged_pixel_by_pixel_and_a_large_one_keeps_its_pixels() -> None:
    errors = np.full((60, 50), np.nan, np.float32)
    errors[10:20, 30:40] = 30
    picture = error_map_picture(errors)
    assert picture.dtype == np.uint8 and picture.shape[0] == 300
    square = np.zeros((300, 250), bool)
    square[50:100, 150:200] = True
    np.testing.assert_array_equal((picture[:, :250] != 255).any(axis=2), square)
    errors = np.random.default_rng(0).uniform(0, 60, (400, 300)).astype(np.float32)
    picture = error_map_picture(errors)
    assert picture.shape[0] == 400
    np.testing.assert_array_equal(picture[:, :300], colour_errors(errors))


@pytest.mark.parametrize("shape", [(1, 1), (10, 2000), (2000, 10), (256, 256)])
def test_the_bar_runs_from_0_to_the_top(shape: tuple[int, int]) -> None:
    picture = error_map_picture(np.full(shape, np.nan, np.float32))
    assert picture.shape[0] == max(shape[0], 256)
    coloured = np.ptp(picture.astype(int), axis=2) > 0  # the map is white and the text is gray
    rows, columns = np.flatnonzero(coloured.any(axis=1)), np.flatnonzero(coloured.any(axis=0))
    bar = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    assert len(bar) > 200
    assert bar.shape[1] >= 18
    np.testing.assert_array_equal(bar[:, 0], colour_errors(np.linspace(TOP_DEG, 0, len(bar))[:, None])[:, 0])
    # Text: black ink right of the bar, and none cut at the picture's edges.
    right = picture[:, columns[-1] + 1 :]
    assert (right < 64).all(axis=2).sum() > 200
    assert (picture[[0, -1]] == 255).all()
    assert (picture[:, -1] == 255).all()
