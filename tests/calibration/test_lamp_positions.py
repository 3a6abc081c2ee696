"""Positions of lamps from mirror balls: the oracle is the law of reflection under a lamp of known position."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.calibration.balls import calibrate_ball, combine_balls, find_ball_files
from splinecli.calibration.circle import Circle
from splinecli.calibration.lamp_positions import intersect_rays, triangulate_lamps
from splinecli.calibration.report import calibration_report, summary_lines
from splinecli.normals import unit

SHAPE = 160, 400
BALLS = Circle(70, 90, 60), Circle(320, 75, 60)


def photograph(circle: Circle, lamp: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A mirror ball under a lamp of 2 degrees at a position in pixels from the middle of the image, 3 x 3 samples."""
    height, width = SHAPE
    offsets = (np.arange(3) - 1) / 3
    rows, cols = ((np.arange(size)[:, None] + offsets).ravel() for size in SHAPE)
    nx, ny = np.meshgrid((cols - circle.x) / circle.radius, (circle.y - rows) / circle.radius)
    inside = nx**2 + ny**2 < 1
    nz = np.sqrt(np.where(inside, 1 - nx**2 - ny**2, 0))
    normals = np.stack((nx, ny, nz), axis=-1)
    centre = np.array((circle.x - (width - 1) / 2, (height - 1) / 2 - circle.y, 0))
    mirrored = 2 * nz[..., None] * normals - (0, 0, 1)
    towards = unit(lamp - centre - circle.radius * normals)
    lit = (mirrored * towards).sum(axis=-1) > np.cos(np.radians(2))
    values = np.where(inside, np.where(lit, 30.0, 0.02), 0.15)
    picture = values.reshape(height, 3, width, 3).mean(axis=(1, 3))
    return np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)


def lamps(distance: float) -> NDArray[np.float64]:
    """Six lamps at 15 to 50 degrees from the view."""
    zenith, azimuth = np.radians(np.linspace(15, 50, 6)), np.arange(6) * 2.4
    directions = (np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith))
    return distance * np.stack(directions, axis=1)


def calibrate(folder: Path, positions: NDArray[np.float64]) -> list:
    balls = []
    for name, circle in zip("ab", BALLS, strict=True):
        (folder / name).mkdir(parents=True)
        for number, lamp in enumerate(positions):
            cv2.imwrite(str(folder / name / f"{number}.png"), photograph(circle, lamp))
        balls.append(calibrate_ball(find_ball_files(folder / name), circle=circle))
    return balls


def test_rays_that_meet() -> None:
    points = np.array([(1.0, 2.0, 5.0), (-3.0, 0.5, 4.0), (0.0, 0.0, 9.0)])
    starts = np.array([[(-1.0, 0.0, 0.0)] * 3, [(1.0, 0.2, 0.0)] * 3])
    found, spread = intersect_rays(starts, unit(points - starts))
    np.testing.assert_allclose(found, points, atol=1e-9)
    np.testing.assert_allclose(spread, 0, atol=1e-9)


def test_the_spread_is_that_of_repeated_measurements() -> None:
    """Directions with errors of 0.5 degrees: the mean of the estimated spreads against the true root mean square."""
    generator = np.random.default_rng(0)
    points = np.tile(((2.0, 1.0, 8.0), (-3.0, 0.5, 6.0), (0.0, -2.0, 7.0)), (20, 1))
    starts = np.stack((np.tile((-1.5, 0, 0), (60, 1)), np.tile((1.5, 0, 0), (60, 1))))
    errors, spreads = [], []
    for _ in range(20):
        noisy = unit(unit(points - starts) + generator.normal(scale=np.radians(0.5), size=(2, 60, 3)))
        found, spread = intersect_rays(starts, noisy)
        errors.append(np.linalg.norm(found - points, axis=1))
        spreads.append(spread)
    # The spread is that along the line of sight, which is nearly the whole error.
    assert np.mean(spreads) == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=0.15)


def test_two_balls_give_positions(tmp_path: Path) -> None:
    """Two balls 250 pixels apart, and lamps 1,500 pixels away: about six widths of a ball of that place."""
    balls = calibrate(tmp_path, lamps(1500.0))
    found = triangulate_lamps(balls, ball_diameter=40.0)
    assert found is not None and found.known
    assert found.pixel_size == pytest.approx(40 / 120)
    errors = np.linalg.norm(found.positions * 3 - lamps(1500.0), axis=1)
    # A highlight is found within 0.2 pixels or so: 0.4 degrees, and at this distance 60 pixels along the rays.
    assert errors.mean() < 75
    assert (3 * found.spread).mean() == pytest.approx(np.sqrt((errors**2).mean()), rel=1.0)
    report = calibration_report(combine_balls(balls), None, None, picture="calibration.png", lamps=found)
    # The balls see the lamps in directions up to 9 degrees apart, which is no disagreement.
    assert report["disagreement_deg"]["largest"] > 3
    assert report["warnings"] == []
    assert "the lamps are 4" in summary_lines(report)[-1]


def test_distant_lamps_have_no_positions(tmp_path: Path) -> None:
    balls = calibrate(tmp_path, lamps(1e6))
    found = triangulate_lamps(balls)
    assert found is not None and not found.known
    report = calibration_report(combine_balls(balls), None, None, picture="calibration.png", lamps=found)
    assert "too parallel" in summary_lines(report)[-1]
    assert triangulate_lamps(balls[:1]) is None
