"""The contact sheet of a capture."""

import numpy as np
from numpy.testing import assert_allclose

from scenes import as_capture, cap_directions, decode_rgb, shade, sphere
from splinecli.pictures.capture_sheet import capture_sheet

LIGHTS = cap_directions(12, 50, 4, even=True)
NORMALS, INSIDE = sphere(48)


def test_images_are_shown_in_order_with_their_lights():
    values = shade(NORMALS[INSIDE], LIGHTS)
    capture = as_capture(values, LIGHTS, INSIDE)
    names = [f"{number}.png" for number in range(12)]
    ambient = np.tile(np.linspace(0, 1, 300), (200, 1))
    png = capture_sheet(capture, names, {"ambient image": ambient}, ["photo.png: left out"])
    sheet = decode_rgb(png).astype(int)
    # ten in a row, each 120 pixels from the next
    for number, (x, y, _) in enumerate(LIGHTS):
        top, left = 8 + number // 10 * (67 + 15 + 8), 8 + number % 10 * 120
        tile = sheet[top : top + 48, left : left + 48]
        shown = np.sqrt(values[:, number] / np.quantile(values, 0.995)).clip(0, 1)
        free = INSIDE.copy()
        free[-31:, -31:] = False  # under the disc
        assert_allclose(tile[free][:, 0], 255 * shown[free[INSIDE]], atol=2)
        dot = np.argwhere((tile == (213, 94, 0)).all(axis=2)).mean(axis=0)
        assert_allclose(dot, (32 - 13 * y, 32 + 13 * x), atol=0.6)
