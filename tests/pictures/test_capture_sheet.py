"""The contact sheet of a capture."""

import cv2
import numpy as np
import pytest

from scenes import cap_directions, decode_rgb, shade, sphere
from splinecli.capture.record import Capture
from splinecli.pictures.capture_sheet import capture_sheet

LIGHTS = cap_directions(12, 50, 4, even=True)
NAMES = [f"{number}.png" for number in range(12)]


def place(number):
    """Return the top and left of a tile of 112 x 112 pixels, ten in a row, with its text below."""
    return 8 + number // 10 * (112 + 32 + 8), 8 + number % 10 * 120


def label(sheet, number):
    top, left = place(number)
    return sheet[top + 113 : top + 144, left : left + 112]


@pytest.mark.parametrize("size", [56, 112, 120])
def test_images_are_shown_in_order_with_their_lights(size):
    """Whole images are shown, as large as the others, with nothing drawn over them."""
    normals, inside = sphere(size)
    values = shade(normals[inside], LIGHTS).astype(np.float32)
    capture = Capture("ball", values, LIGHTS, tuple(range(12)), inside)
    ambient = np.tile(np.linspace(0, 1, 300), (200, 1))
    png = capture_sheet(capture, NAMES, {"ambient image": ambient}, ["p.png: left out"])
    sheet = decode_rgb(png).astype(int)
    for number, (x, y, _) in enumerate(LIGHTS):
        top, left = place(number)
        tile = sheet[top : top + 112, left : left + 112]
        image = np.zeros(inside.shape)
        image[inside] = np.sqrt(values[:, number] / np.quantile(values, 0.995)).clip(0, 1)
        how = cv2.INTER_AREA if size > 112 else cv2.INTER_NEAREST
        shown = 255 * cv2.resize(image, (112, 112), interpolation=how)
        np.testing.assert_allclose(tile[..., 0], shown, atol=2)
        below = label(sheet, number)
        dot = np.argwhere((below == (213, 94, 0)).all(axis=2)).mean(axis=0)
        np.testing.assert_allclose(dot, (15 - 13 * y, 15 + 13 * x), atol=0.6)


def test_white_pictures_stand_out():
    """A mask of all pixels and a uniform ambient image differ from the background of the sheet."""
    values = np.full((112 * 112, 12), 0.5, np.float32)
    capture = Capture("flat", values, LIGHTS, tuple(range(12)), np.ones((112, 112), np.bool_))
    ambient = {"ambient image": np.full((112, 112), 0.01)}
    sheet = decode_rgb(capture_sheet(capture, NAMES, ambient, [])).astype(int)
    (top, left), (_, second) = place(12), place(13)
    background = sheet[1, 1]
    assert (sheet[top + 50, left + 50] == 255).all() and (background < 240).all()
    assert (sheet[top + 50, second + 50] < background).all()
    for edge in (left, second):
        assert (sheet[top - 1 : top + 113, edge - 1] < 150).all()


def test_long_names_differ_on_the_sheet():
    values = np.full((112 * 112, 12), 0.5, np.float32)
    capture = Capture("flat", values, LIGHTS, tuple(range(12)), np.ones((112, 112), np.bool_))

    def labels(names):
        sheet = decode_rgb(capture_sheet(capture, names, {}, []))
        return [label(sheet, number)[:, 50:].tobytes() for number in range(12)]

    long = labels([f"a_session_of_many_photographs_{name}" for name in NAMES])
    assert long == labels([f"...{number}" for number in range(12)])
    assert len(set(long)) == 12
