"""Known values of maps have known colours, and PNG files keep every value."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splinecli.errors import OutputError
from splinecli.pictures.maps import PREVIEW_LIGHT, albedo_picture, confidence_picture, preview_picture
from splinecli.pictures.png import encode_png


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


def test_a_black_albedo_is_black():
    assert not albedo_picture(np.zeros((3, 3, 3), np.float32), np.ones((3, 3), bool)).any()


def test_confidence_is_gray():
    assert confidence_picture(np.array([[0, 0.6, 1]], np.float32)).tolist() == [[0, 153, 255]]


def test_the_preview_is_brightest_where_the_surface_faces_the_light():
    light = np.array(PREVIEW_LIGHT) / np.linalg.norm(PREVIEW_LIGHT)
    across = np.cross(light, (0, 0, 1)) / np.linalg.norm(np.cross(light, (0, 0, 1)))
    half = (light + np.sqrt(3) * across) / 2  # 60 degrees from the light
    normals = np.array([[light, half, -light, light]], np.float32)
    picture = preview_picture(normals, np.array([[True, True, True, False]]))
    assert picture[0].tolist() == [[255] * 3, [188] * 3, [0] * 3, [0] * 3]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(7, 5), (7, 5, 3)])
def test_png_keeps_every_value(dtype, shape):
    picture = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    stored = cv2.imdecode(np.frombuffer(encode_png(picture), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(stored if picture.ndim == 2 else stored[..., ::-1], picture)


def test_a_picture_that_cannot_be_encoded(monkeypatch):
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, np.empty(0, np.uint8)))
    with pytest.raises(OutputError, match="cannot be encoded as PNG"):
        encode_png(np.zeros((2, 2), np.uint8))
