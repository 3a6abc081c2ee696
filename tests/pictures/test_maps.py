"""Maps, plots and observation maps: known values have known colours at known places, in every size
of picture.

PNG files keep every value; curves leave out what was not computed, and anything may be a title.
"""

from itertools import product

import cv2
import numpy as np
from numpy.testing import assert_array_equal
from pytest import approx

from scenes import decode_rgb, parametrize, refuses
from splinecli.errors import OutputError
from splinecli.maths.normals import unit
from splinecli.pictures.maps import (
    PREVIEW_LIGHT,
    TOP_DEG,
    albedo_picture,
    colour_errors,
    encode_png,
    preview_picture,
)
from splinecli.pictures.plots import (
    error_map_picture,
    method_maps,
    observation_map_figure,
    sky_plot,
    training_figure,
)


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
    for dtype, shape in product((np.uint8, np.uint16), ((7, 5), (7, 5, 3))):
        most = np.iinfo(dtype).max
        picture = np.random.default_rng(0).integers(0, most, shape, dtype, endpoint=True)
        stored = cv2.imdecode(np.frombuffer(encode_png(picture), np.uint8), cv2.IMREAD_UNCHANGED)
        assert_array_equal(stored if picture.ndim == 2 else stored[..., ::-1], picture)
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, np.empty(0, np.uint8)))
    with refuses("cannot be encoded as PNG", OutputError):
        encode_png(np.zeros((2, 2), np.uint8))


# The ends and the middle of viridis as its authors publish it (bids.github.io/colormap), times 255.
VIOLET, TEAL, YELLOW = (68, 1, 84), (33, 145, 140), (253, 231, 37)
WHITE = (255, 255, 255)


def test_known_errors_have_known_colours():
    colours = colour_errors(np.array([[0, 15, 30, 180, np.nan]], np.float32)).astype(int)
    wanted = np.array([[VIOLET, TEAL, YELLOW, YELLOW, WHITE]])
    assert np.abs(colours - wanted).max() <= 2  # OpenCV's table is rounded in its own way
    assert (colours[0, 4] == 255).all()


def test_a_small_map_is_enlarged_pixel_by_pixel_and_a_large_one_keeps_its_pixels(rng):
    errors = np.full((60, 50), np.nan, np.float32)
    errors[10:20, 30:40] = 30
    picture = error_map_picture(errors)
    assert picture.dtype == np.uint8 and picture.shape[0] == 300
    square = np.zeros((300, 250), bool)
    square[50:100, 150:200] = True
    assert_array_equal((picture[:, :250] != 255).any(axis=2), square)
    errors = rng.uniform(0, 60, (400, 300)).astype(np.float32)
    picture = error_map_picture(errors)
    assert picture.shape[0] == 400
    assert_array_equal(picture[:, :300], colour_errors(errors))


@parametrize("shape", [(1, 1), (10, 2000), (2000, 10), (256, 256)])
def test_the_bar_runs_from_0_to_the_top(shape):
    picture = error_map_picture(np.full(shape, np.nan, np.float32))
    assert picture.shape[0] == max(shape[0], 256)
    coloured = np.ptp(picture.astype(int), axis=2) > 0  # the map is white and the text is gray
    rows, columns = np.flatnonzero(coloured.any(axis=1)), np.flatnonzero(coloured.any(axis=0))
    bar = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    assert len(bar) > 200
    assert bar.shape[1] >= 18
    assert_array_equal(bar[:, 0], colour_errors(np.linspace(TOP_DEG, 0, len(bar))[:, None])[:, 0])
    # Text: black ink right of the bar, and none cut at the picture's edges.
    assert (picture[:, columns[-1] + 1 :] < 64).all(axis=2).sum() > 200
    assert (picture[[0, -1]] == 255).all()
    assert (picture[:, -1] == 255).all()


COLUMNS = {
    "step": [50, 100, 125],
    "loss": [2.0, 1.0, 0.5],
    "symmetric": [None, 0.5, None],
    "asymmetric": [None] * 3,
    "angle_deg": [20.0, 10.0, 8.0],
    "validation_deg": [None, 12.5, 9.0],
    "map_error": [0.2, 0.1, 0.08],
    "masked_map_error": [0.1, 0.05, 0.04],
}


def lines(axes):
    return {
        line.get_label(): [list(map(float, values)) for values in line.get_data()]
        for line in axes.lines
    }


def test_each_curve_leaves_out_what_was_not_computed():
    loss, angle, maps = training_figure(COLUMNS).axes
    steps = [50, 100, 125]
    assert lines(loss) == {
        "weighted sum": [steps, [2.0, 1.0, 0.5]],
        "Ls, unweighted": [[100], [0.5]],
    }
    assert lines(angle) == {"training": [steps, [20, 10, 8]], "validation": [[100, 125], [12.5, 9]]}
    assert lines(maps) == {
        "all cells": [steps, [0.2, 0.1, 0.08]],
        "cells with a light": [steps, [0.1, 0.05, 0.04]],
    }
    assert {axes.get_xlabel() for axes in (loss, angle, maps)} == {"step"}
    assert loss.get_title() == "loss"
    assert loss.get_yscale() == "linear"


def test_scales_and_hidden_axes():
    """Wide curves are logarithmic unless a value is zero; without a LI-Net, the map errors are
    hidden.
    """
    for middle, scale in ((1.0, "log"), (0.0, "linear")):
        assert (
            training_figure(COLUMNS | {"loss": [50.0, middle, 0.5]}).axes[0].get_yscale() == scale
        )
    columns = COLUMNS | {"map_error": [None] * 3, "masked_map_error": [None] * 3}
    assert [axes.get_visible() for axes in training_figure(columns).axes] == [True, True, False]


LIGHTS = np.array([(0, 0, 1), (0.6, 0, 0.8)])


@parametrize("name", ["b\udcff", "a\nb\x1b[2J", r"$\frac$"])
def test_a_name_that_is_not_printable_or_a_formula(name):
    assert sky_plot(LIGHTS, name) != sky_plot(LIGHTS, "")


def draw(height, width, methods, error_deg=12.0, title="title"):
    """A mask that leaves a margin of two pixels free, ground truth (0, 0, 1), estimates along (1,
    0, 1).
    """
    mask = np.zeros((height, width), bool)
    mask[2:-2, 2:-2] = True
    truth = np.zeros((height, width, 3), np.float32)
    truth[mask] = (0, 0, 1)
    estimate = np.full_like(truth, np.nan)
    estimate[mask] = unit(np.array([1.0, 0.0, 1.0]))
    errors = np.where(mask, np.float32(error_deg), np.float32(np.nan))
    estimates, error_maps = dict.fromkeys(methods, estimate), dict.fromkeys(methods, errors)
    return decode_rgb(method_maps(truth, mask, estimates, error_maps, title=title))


def places_of(colour, picture):
    """Boxes (top, left, height, width) of the large connected areas of a colour, from the top."""
    same = np.uint8(np.abs(picture.astype(int) - colour).max(axis=2) <= 2)
    _, _, found, _ = cv2.connectedComponentsWithStats(same)
    return sorted((int(y), int(x), int(h), int(w)) for x, y, w, h, area in found[1:] if area > 400)


BLUE = (128, 128, 255)  # of (0, 0, 1)
TILTED = (218, 128, 218)  # of (1, 0, 1) / sqrt 2


def error_colour(error_deg):
    return tuple(int(value) for value in colour_errors(np.array([[error_deg]]))[0, 0])


@parametrize("n_methods", [1, 2, 9])
@parametrize("height, width", [(10, 10), (300, 200), (40, 120), (120, 40)])
def test_colours_stand_where_they_belong(height, width, n_methods):
    picture = draw(height, width, [f"method {i}" for i in range(n_methods)])
    [truth] = places_of(BLUE, picture)
    normals, errors = places_of(TILTED, picture), places_of(error_colour(12), picture)
    assert len(normals) == len(errors) == n_methods
    # Cut to the mask's box and enlarged by a whole factor, all alike.
    factor = truth[2] // (height - 4)
    assert {place[2:] for place in (truth, *normals, *errors)} == {
        (factor * (height - 4), factor * (width - 4))
    }
    # One row of normals, ground truth first; each method's errors below its normals.
    assert {place[0] for place in normals} == {truth[0]}
    assert truth[1] < normals[0][1]
    assert [place[1] for place in errors] == [place[1] for place in normals]
    assert errors[0][0] >= truth[0] + truth[2]


def test_the_frame_is_not_turned():
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


def test_nothing_is_cut_at_the_edges_and_the_bar_runs_over_the_whole_scale():
    picture = draw(300, 300, ["ls"])
    for error_deg in (0.0, TOP_DEG / 2, TOP_DEG):
        assert (picture == error_colour(error_deg)).all(axis=2).sum() >= 10
    long = (
        "a capture with quite a long name, 10 lights, draw 1 of 10, seed 0, light noise of 2"
        " degrees $x$"
    )
    for methods in (["ls"], ["a method with a long name", "b"]):
        picture = draw(20, 30, methods, title=long)
        for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
            assert (edge == 255).all()


SIZE = 8
CELL_YELLOW, CELL_VIOLET = (253, 231, 36), (68, 1, 84)  # viridis' ends


def draw_cells(n_pixels):
    """RGB (H, W, 3). Sparse maps have a one at row 1, column 5; dense maps are zeros; the truth is
    empty.
    """
    sparse = np.full((n_pixels, SIZE, SIZE), np.nan, np.float32)
    sparse[:, 1, 5] = 1
    png = observation_map_figure(
        sparse,
        np.zeros_like(sparse),
        {"true map, all lights": np.full_like(sparse, np.nan)},
        pixels=np.array([[12, 34]] * n_pixels),
        error_deg=np.full(n_pixels, 3.25),
        title="$cat$, 10 lights",
        grid="even",
    )
    return decode_rgb(png)


@parametrize("n_pixels", [1, 4])
def test_cells_stand_where_they_are(n_pixels):
    picture = draw_cells(n_pixels)
    # Frames around a map, from its empty corner beside the circle.
    dense = [box for box in places_of(CELL_VIOLET, picture) if min(box[2:]) > 100]
    assert len(dense) == n_pixels
    for cell, whole in zip(places_of(CELL_YELLOW, picture), dense, strict=True):
        side = whole[2] / SIZE
        assert cell[2:] == approx([side, side], abs=2)
        assert cell[0] - whole[0] == approx(side, abs=3)  # row 1
        assert cell[1] < whole[1]  # the sparse map is left of the dense one
