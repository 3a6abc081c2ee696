"""Levelled surfaces: tilted plates with bumps, whose slopes are known."""

import json

import numpy as np
from pytest import approx

from scenes import parametrize, pinhole, read_json, refuses, tilted
from splinecli.errors import UsageError
from splinecli.maths.normals import angle_between_deg
from splinecli.pipeline.integrate import integrate_normal_map
from splinecli.pipeline.options import IntegrateOptions, parse_level
from splinecli.surface.levelling import level_heights, level_normals, plane_slopes

SLOPES = 0.2, -0.1
MASK = np.ones((60, 80), np.bool_)


def plate(slopes=SLOPES, aspect=1.0):
    """Return heights (60, 80) and normals of a plate with a bump on a fifth of it; pixels are
    `aspect` high.
    """
    rows, columns = np.indices(MASK.shape)
    x, y = columns - 20.0, -(rows - 30.0) * aspect
    inside = np.hypot(x, y) < 15
    bump = np.where(inside, (225 - x**2 - y**2) / 60, 0)
    heights = bump + slopes[0] * columns - slopes[1] * aspect * rows
    right, up = (
        np.where(inside, -axis / 30, 0) + slope for axis, slope in zip((x, y), slopes, strict=True)
    )
    return heights, tilted(-right, -up)


@parametrize("points", [(), ((60, 5), (75, 50), (50, 30))], ids=["plane", "points"])
@parametrize("aspect", [1.0, 2.5])
def test_the_slope_of_the_plate_is_removed(points, aspect):
    heights, normals = plate(aspect=aspect)
    slopes = plane_slopes(heights, points, aspect=aspect)
    assert slopes == approx(SLOPES, abs=0.003)
    flat, flat_normals = plate((0.0, 0.0), aspect)
    assert np.ptp(level_heights(heights, slopes, aspect=aspect) - flat) < 0.5
    assert angle_between_deg(level_normals(normals, MASK, slopes), flat_normals).max() < 0.2


def test_integrate_levels_depth_and_normals(tmp_path):
    np.save(tmp_path / "n.npy", np.float32(plate(aspect=2.0)[1]))
    options = IntegrateOptions(
        normals=tmp_path / "n.npy",
        level=(),
        pixel_aspect=2.0,
        pixel_size=0.5,
        formats=("npy", "ply"),
    )
    report = integrate_normal_map(options)
    assert json.loads(json.dumps(report)) == read_json(tmp_path / "surface.json")
    assert report["level"]["tilt_deg"] == approx(np.degrees(np.arctan(np.hypot(*SLOPES))), abs=0.3)
    assert {"level_normals.npy", "level_normals.png"} <= set(report["files"])
    depth = np.load(tmp_path / "depth.npy")
    true = 0.5 * plate((0.0, 0.0), 2.0)[0]
    # mm; the rim of the bump is a crease
    assert np.abs(depth - depth[:, 60:].mean() - true).max() < 0.3
    flat = np.load(tmp_path / "level_normals.npy")[:, 50:]
    assert angle_between_deg(flat, np.broadcast_to((0.0, 0.0, 1.0), flat.shape)).max() < 0.3


def test_levels_are_parsed():
    assert parse_level("plane") == () and parse_level("1,2 30,4  5,60") == (
        (1, 2),
        (30, 4),
        (5, 60),
    )
    for text in ("1,2 3,4", "flat", "1,2 3,4 5"):
        with refuses("three points", UsageError):
            parse_level(text)


def test_points_must_be_on_the_object_and_not_in_a_line():
    heights = plate()[0]
    with refuses("the point 90,10 of --level is not on the object", UsageError):
        plane_slopes(heights, ((1, 1), (5, 5), (90, 10)))
    for points in (((1, 1), (5, 5), (20, 20)), ((5, 5), (5, 5), (5, 5))):
        with refuses("the points of --level are on one line", UsageError):
            plane_slopes(heights, points)
    for line in (heights[:1], heights[:, :1], heights[:1, :1]):
        with refuses("the pixels of the object are on one line", UsageError):
            plane_slopes(line)


def test_a_camera_matrix_contradicts_levelling(tmp_path):
    np.save(tmp_path / "n.npy", np.float32(plate()[1]))
    np.savetxt(tmp_path / "camera.txt", pinhole(100, 40, 30))
    with refuses("orthographic", UsageError):
        integrate_normal_map(
            IntegrateOptions(
                normals=tmp_path / "n.npy", camera_matrix=tmp_path / "camera.txt", level=()
            )
        )
