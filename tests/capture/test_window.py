"""--crop and --scale: what is read is a part of the whole capture, and so are the results."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenes import parametrize, put, refuses, write_image
from splinecli.capture import CaptureOptions, open_capture
from splinecli.capture.linearise import parse_window
from splinecli.errors import SplinecliError, UsageError
from splinecli.estimate.inference import lighting_on
from splinecli.lights.lighting import PixelLighting, flat_depth, surface_points
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions, InfoOptions
from splinecli.pipeline.info import describe_capture
from splinecli.recipe import RecipeOptions, prepare_capture

MEDALLION = Path(__file__).parents[2] / "examples/medallion"
WINDOWS = [("31,22,50,47", None), (None, "1/3"), ("31,22,50,47", "1/4")]


def on_image(mask, values):
    """Return the map (H, W, C) of the values (P, C) of a mask (H, W)."""
    image = np.zeros((*mask.shape, *values.shape[1:]), values.dtype)
    image[mask] = values
    return image


def test_ambient_and_flat_field_are_read_in_the_window(tmp_path, rng):
    """Both change from pixel to pixel, so other pixels of them would give other observations."""
    folder = tmp_path / "capture"
    shutil.copytree(MEDALLION, folder)
    shape = cv2.imread(str(folder / "01.png")).shape[:2]
    pattern = np.uint8(rng.integers(1, 30, shape))
    write_image(folder / "ambient.png", pattern)
    flats = tmp_path / "flats"
    flats.mkdir()
    write_image(flats / "flat.png", 255 - pattern)
    maps = []
    for crop, scale in ((None, None), WINDOWS[2]):
        options = InferOptions(method="ls", crop=crop, scale=scale, flat_field=str(flats))
        capture = prepare_capture(options.open(folder), options=RecipeOptions(as_stored=True))
        maps.append(on_image(capture.mask, capture.observations))
    part = parse_window(*WINDOWS[2]).of(maps[0])
    # The flat field is divided by its mean over the pixels that are read.
    ratio = maps[1][part > 0] / part[part > 0]
    assert_allclose(ratio, ratio[0], rtol=1e-4)


@parametrize("crop, scale", WINDOWS)
def test_results_are_a_part_of_those_of_the_whole(crop, scale, tmp_path):
    maps = {}
    for name, options in (("whole", (None, None)), ("part", (crop, scale))):
        crop_and_scale = dict(zip(("crop", "scale"), options, strict=True))
        record = InferOptions(
            method="ls", maps=("albedo",), output=str(tmp_path / name), **crop_and_scale
        )
        report = infer_capture(MEDALLION, record)
        assert (report["options"]["crop"], report["options"]["scale"]) == options
        folder = tmp_path / name / "medallion"
        maps[name] = np.load(folder / "normals.npy"), np.load(folder / "albedo.npy")
    for whole, part in zip(maps["whole"], maps["part"], strict=True):
        assert_allclose(part, parse_window(crop, scale).of(whole), atol=1e-5)


def test_windows_in_words():
    assert (
        parse_window(*WINDOWS[2]).in_words()
        == "50 x 47 pixels from (31, 22), one in 4 rows and columns"
    )
    assert describe_capture(InfoOptions(capture=MEDALLION))["reads"] is None


@parametrize(
    "crop, scale, problem",
    [
        ("1,2,3", None, "--crop is '1,2,3'; expected X,Y,W,H"),
        ("-1,0,5,5", None, "--crop is"),
        ("0,0,0,5", None, "--crop is"),
        (None, "4", "--scale is '4'; expected 1/N"),
        (None, "1/0", "--scale is"),
        (None, "0.5", "--scale is"),
    ],
)
def test_values_that_mean_nothing_are_refused(crop, scale, problem):
    with refuses(problem, UsageError):
        InferOptions(crop=crop, scale=scale)


def test_windows_that_do_not_fit_are_refused():
    with refuses("--crop 0,0,5000,5 extends beyond the image of"):
        open_capture(MEDALLION, CaptureOptions(window=parse_window("0,0,5000,5", None)))
    with refuses("no pixels in the part that is read"):
        prepare_capture(
            open_capture(MEDALLION, CaptureOptions(window=parse_window("0,0,3,3", None)))
        )


@parametrize("crop, scale", WINDOWS)
@parametrize("near, perspective", [(True, False), (True, True), (False, True)])
def test_a_part_is_lit_and_seen_as_in_the_whole(crop, scale, near, perspective, tmp_path):
    """Under near lamps, and by a near camera."""
    matrix = tmp_path / "camera.txt"
    put(matrix, "300 2 52\n0 300 61\n0 0 1\n")
    lamps = {"light_distance": 40.0, "pixel_size": 0.1} if near else {}
    images = []
    for options in ((None, None), (crop, scale)):
        camera = str(matrix) if perspective else None
        record = InferOptions(crop=options[0], scale=options[1], camera_matrix=camera, **lamps)
        capture = prepare_capture(record.open(MEDALLION), options=RecipeOptions(as_stored=True))
        lit = lighting_on(capture)(None, np.arange(capture.n_pixels)) if not near else None
        if near:
            places = [np.float64(places) for places in np.nonzero(capture.mask)]
            points = surface_points(  # type: ignore[call-arg]
                capture.lamps, *places, np.full(capture.n_pixels, flat_depth(capture.lamps))
            )
            lit = PixelLighting.of(capture.observations, replace(capture.lamps, points=points))
        values = (
            lit.directions.reshape(capture.n_pixels, -1),
            capture.observations if not near else lit.observations,
        )
        images.append(on_image(capture.mask, np.concatenate(values, axis=1)))
    whole, part = images
    assert_allclose(part, parse_window(crop, scale).of(whole), rtol=1e-4, atol=1e-5)


def test_the_width_of_a_part_is_not_that_of_the_object():
    options = InferOptions(crop="31,22,50,47", light_distance=400.0, object_width=10.0)
    with refuses("--object-width requires the whole object to be in the image", SplinecliError):
        options.open(MEDALLION)
    narrow = prepare_capture(
        InferOptions(scale="1/3", light_distance=400.0, object_width=10.0).open(MEDALLION)
    )
    wide = prepare_capture(InferOptions(light_distance=400.0, object_width=10.0).open(MEDALLION))
    assert narrow.lamps.pixel_size == pytest.approx(3 * wide.lamps.pixel_size, rel=0.03)
