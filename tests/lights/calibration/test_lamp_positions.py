"""Positions of lamps from mirror balls, and the report of a calibration.

The oracles are the law of reflection under a lamp of known position, and lights whose errors are
known.
"""

from pathlib import Path

import numpy as np
import pytest

from scenes import directions_at, parametrize, pinhole, spiral_lights, write_image
from splinecli.lights.calibration.balls import (
    DISTANT,
    SHORTEST_LENS,
    BallCalibration,
    BallFiles,
    Highlight,
    View,
    calibrate_ball,
    combine_balls,
    find_ball_files,
)
from splinecli.lights.calibration.circle import Circle
from splinecli.lights.calibration.lamps import (
    calibration_lines,
    calibration_report,
    triangulate_lamps,
)
from splinecli.maths.normals import unit

SHAPE = 160, 400
BALLS = Circle(70, 90, 60), Circle(320, 75, 60)


def lamps(distance):
    """Six lamps at 15 to 50 degrees from the view."""
    return distance * spiral_lights(6, 50, 15)


def calibrate(folder, render_ball, positions, *, known=True):
    """The balls, with the matrix of a camera that is far away or without one."""
    matrix = folder / "matrix.txt"
    np.savetxt(matrix, ((1e6, 0, 199.5), (0, 1e6, 79.5), (0, 0, 1)))
    balls = []
    for name, circle in zip("ab", BALLS, strict=True):
        (folder / name).mkdir(parents=True)
        for number, lamp in enumerate(positions):
            picture = render_ball(lamp, circle.x, circle.y, circle.radius, SHAPE, near=True)
            write_image(
                folder / name / f"{number}.png", np.uint8(np.rint(picture.clip(0, 1) * 255))
            )
        files = find_ball_files(folder / name)
        balls.append(calibrate_ball(files, circle=circle, camera_matrix=matrix if known else None))
    return balls


FIELD = 400.0  # millimetres that the image shows across, on the balls' plane
PIXELS = (2000, 3000)


def photographed(rng, camera, source, *, height=0.0):
    """Lamps (6, 3), and two balls of 40 mm as a pinhole camera sees them, 80 mm being the width of
    the object.

    The highlight is where the normal halves the angle between camera and lamp, found by iteration.
    Outlines are the points at which lines of sight touch the ball. Pixels have errors of 0.3.

    Args:
        camera: its distance in widths.
        source: of the camera matrix; see View.
        height: one ball lies this much above the plane z = 0, the other as much below.
    """
    eye = np.array((0, 0, 80 * camera))
    focal = PIXELS[1] * eye[2] / FIELD
    middle = np.array(((PIXELS[1] - 1) / 2, (PIXELS[0] - 1) / 2))

    def image_of(points):
        seen = points - eye
        return middle + focal * seen[:, :2] / -seen[:, 2:] * (1, -1)

    zenith, azimuth = np.radians(rng.uniform(15, 50, 6)), rng.uniform(0, 2 * np.pi, 6)
    towards = directions_at(azimuth, zenith)
    places = towards * rng.uniform(300, 700, (6, 1)) * min(1, eye[2] / 900)
    assumed = {"EXIF": focal * np.exp(0.05 * rng.normal()), "assumed distant": DISTANT}.get(
        source, focal
    )
    matrix = pinhole(assumed, middle[0], middle[1])
    view = View(matrix, source, SHORTEST_LENS * PIXELS[1])
    balls = []
    for side in (-1, 1):
        centre = np.array((120.0 * side, rng.uniform(-30, 30), height * side))
        normals = np.tile(unit(eye - centre), (6, 1))
        for _ in range(60):
            surface = centre + 20 * normals
            normals = unit(unit(eye - surface) + unit(places - surface))
        highlights = image_of(centre + 20 * normals) + 0.3 * rng.normal(size=(6, 2))
        away = np.linalg.norm(eye - centre)
        across = np.linalg.svd((eye - centre)[None])[2][1:]
        angle = np.arange(360)[:, None] * np.pi / 180
        rim = np.cos(angle) * across[0] + np.sin(angle) * across[1]
        outline = image_of(
            centre + 400 / away * (eye - centre) / away + 20 * np.sqrt(1 - (20 / away) ** 2) * rim
        )
        x, y = outline.mean(axis=0)
        radius = float(np.hypot(*(outline - (x, y)).T).mean())
        outline += (outline - (x, y)) * (0.3 * rng.normal() / radius) + 0.3 * rng.normal(size=2)
        circle = Circle(float(x), float(y), radius, points=outline)
        marks = tuple(Highlight(*point, 0.0, np.eye(2)) for point in highlights.tolist())  # type: ignore[call-arg]
        files = BallFiles(Path("ball"), (), None, None)
        balls.append(
            BallCalibration(files, circle, "--circle", marks, towards, normals, view, PIXELS)
        )
    return places, balls


@parametrize("source", ["--camera-matrix", "EXIF", "assumed distant"])
def test_the_uncertainty_covers_the_error(source, rng):
    """Cameras at 5 to 100 widths of the object: 9 of 10 errors or more are within the stated
    uncertainty.
    """
    covered, errors = [], []
    for camera in (5, 10, 25, 50, 100):
        for height in (0.0, 10.0):
            places, balls = photographed(rng, camera, source, height=height)
            found = triangulate_lamps(balls, ball_diameter=40.0)
            error = np.linalg.norm(found.positions - places, axis=1)
            covered.append(error <= found.uncertainty)
            errors.append(error / np.linalg.norm(places, axis=1))
            assert found.known or source != "--camera-matrix"
            if source == "assumed distant":
                assert not found.known  # a usual lens could be as near as 3 widths
            elif found.known:
                assert found.pixel_size == pytest.approx(FIELD / PIXELS[1], rel=0.01)
    assert np.mean(covered) >= 0.9
    if source == "--camera-matrix":
        assert np.mean(errors) < 0.03


def test_two_balls_give_positions(tmp_path, render_ball):
    """Two balls 250 pixels apart, and lamps 1,200 pixels away: about five times as far."""
    balls = calibrate(tmp_path, render_ball, lamps(1200.0))
    found = triangulate_lamps(balls, ball_diameter=40.0)
    assert found is not None and found.known
    assert found.pixel_size == pytest.approx(40 / 120)
    errors = np.linalg.norm(found.positions * 3 - lamps(1200.0), axis=1)
    # A highlight is found within 0.2 pixels or so: 0.4 degrees, and at this distance 60 pixels
    # along the rays.
    assert errors.mean() < 75
    assert (errors < 3 * found.uncertainty).all()
    report = calibration_report(
        combine_balls(balls), None, None, picture="calibration.png", lamps=found
    )
    # The balls see the lamps in directions up to 9 degrees apart, which is no disagreement.
    assert report["disagreement_deg"]["largest"] > 3
    assert report["warnings"] == []
    assert "the lamps are 3" in calibration_lines(report)[-1]


@parametrize("known", [True, False])
def test_lamps_without_positions(tmp_path, render_ball, known):
    """Distant lamps, and near ones that an unknown camera photographs."""
    balls = calibrate(tmp_path, render_ball, lamps(1e6 if known else 1500.0), known=known)
    found = triangulate_lamps(balls)
    assert found is not None and not found.known
    report = calibration_report(
        combine_balls(balls), None, None, picture="calibration.png", lamps=found
    )
    assert (
        calibration_lines(report)[-1]
        == "the distances of the lamps are unknown, so the lamps are treated as distant"
    )
    expected = (
        "move the balls farther apart" if known else "If the lamps are near, add --camera-matrix."
    )
    assert any(expected in warning for warning in report["warnings"])
    assert triangulate_lamps(balls[:1]) is None


def turned(directions, degrees):
    """Turn directions (F, 3) about the x axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return directions @ np.array([(1, 0, 0), (0, cosine, sine), (0, -sine, cosine)])


def ball(directions):
    files = BallFiles(Path("ball"), (Path("ball/1.png"),) * len(directions), None, None)
    highlights = tuple(Highlight(1.23456, 2.0, 0.25, np.eye(2)) for _ in directions)
    normals = unit(directions + np.array((0, 0, 1)))
    view = View(np.eye(3), "assumed distant", 1.0)
    return BallCalibration(
        files, Circle(50, 40, 30), "--circle", highlights, directions, normals, view, (100, 100)
    )


def report(balls, known=None):
    return calibration_report(combine_balls(balls), None, known, picture="calibration.png")


@pytest.fixture
def directions():
    """Four lights (4, 3) in the plane x, z, so that all turn alike about the x axis where x is
    zero.
    """
    return unit(np.array([(0.0, 0.0, 1.0)] * 4))


@parametrize(("degrees", "warned"), [(9.8, False), (10.2, True)])
def test_balls_that_disagree(directions, degrees, warned):
    # The mean of two directions lies half-way, so each differs from it by half the angle; the limit
    # is 5 degrees.
    found = report([ball(directions), ball(turned(directions, degrees))])
    assert found["disagreement_deg"] == {"mean": degrees / 2, "largest": degrees / 2}
    assert bool(found["warnings"]) == warned
    assert (
        f"the balls differ from their mean by {degrees / 2:.1f} degrees"
        in calibration_lines(found)[-1]
    )


def test_a_compared_file(directions):
    lights = turned(directions, 40)
    found = report([ball(lights)], turned(lights, 2))
    assert found["compared"] == {"mean_deg": 2.0, "largest_deg": 2.0}
    assert found["warnings"] == []
    # The normal at the highlight halves the angle of 40 degrees.
    found = report([ball(lights)], turned(directions, 20))
    assert found["compared"] == {"mean_deg": 20.0, "largest_deg": 20.0}
    assert "the normals of the ball at the highlights, which are halfway" in found["warnings"][0]
    # Directions that are wrong in another way are not mistaken for normals.
    assert report([ball(lights)], turned(lights, 20))["warnings"] == []
