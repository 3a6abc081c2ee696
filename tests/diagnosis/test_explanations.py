"""Encoded values and near lamps, found in scenes of known curve and lamps."""

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import spiral_lights
from splinecli.capture.capture_warnings import CaptureWarning
from splinecli.capture.lights.near_lamps import NearLamps
from splinecli.capture.sample import Sample
from splinecli.diagnosis.explanations import encoded_values, near_distance, near_lamps
from splinecli.maths.normals import unit
from splinecli.maths.transfer import encode_srgb

Array = NDArray[np.float64]
SIZE = 48
LIGHTS = spiral_lights(10, 52, 15)


def scene(shape: str, *, widths: float | None = None, shine: float = 0.0) -> Sample:
    """Return a relief over the picture or a ball, with shine by Blinn and Phong, under distant lights or near lamps."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[1 : -1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    if shape == "ball":
        mask = np.hypot(x, y) < 0.95
        slopes = np.stack((x, y), axis=2) / np.sqrt(np.maximum(1 - x**2 - y**2, 1e-3))[..., None]
    else:
        mask = np.ones((SIZE, SIZE), np.bool_)
        slopes = np.stack((0.5 * np.cos(5 * x) * np.cos(4 * y), 0.4 * np.sin(5 * x) * np.sin(4 * y)), axis=2)
    normals = unit(np.concatenate((slopes, np.ones((SIZE, SIZE, 1))), axis=2))[mask]
    directions, strengths = LIGHTS[None], np.ones(1)
    if widths is not None:
        lamps = NearLamps.of(LIGHTS * widths * SIZE, 1.0, mask.shape, equal=True)
        directions, strengths = lamps.light_at(lamps.plane_points(*np.nonzero(mask)))
    half = unit(directions + np.array((0.0, 0.0, 1.0)))
    albedo = rng.uniform(0.4, 0.8, (len(normals), 1))
    cosine = np.maximum((normals[:, None] * directions).sum(axis=2), 0)
    shaded = albedo * cosine + shine * np.maximum((normals[:, None] * half).sum(axis=2), 0) ** 30
    values = shaded * strengths
    return Sample((values + rng.normal(0, 0.003, values.shape)).clip(0, 1), mask, 1)


def found(sample: Sample) -> list[CaptureWarning]:
    return [*encoded_values(sample, LIGHTS), *near_lamps(sample, LIGHTS)]


@pytest.mark.parametrize("shape", ["ball", "relief"])
@pytest.mark.parametrize("shine", [0.0, 0.2])
def test_right_captures_are_not_doubted(shape: str, shine: float) -> None:
    assert found(scene(shape, shine=shine)) == []


@pytest.mark.parametrize("shape", ["ball", "relief"])
@pytest.mark.parametrize("shine", [0.0, 0.2])
def test_encoded_values(shape: str, shine: float) -> None:
    linear = scene(shape, shine=shine)
    encoded = Sample(encode_srgb(linear.observations) / 255, linear.mask, 1)
    (warning,) = encoded_values(encoded, LIGHTS)
    assert warning.code == "encoded_values" and "--transfer srgb" in warning.text


@pytest.mark.parametrize(("widths", "shine"), [(2.0, 0.0), (3.0, 0.0), (4.0, 0.0), (2.0, 0.1), (3.0, 0.1)])
def test_near_lamps(widths: float, shine: float) -> None:
    near = scene("relief", widths=widths, shine=shine)
    distance = near_distance(near, LIGHTS)
    # An error of 20 % costs 2 to 4 degrees, where distant lights cost 6 to 20.
    assert distance is not None and distance[0] == pytest.approx(widths, rel=0.2)
    (warning,) = found(near)
    assert warning.code == "lamps_near"
    assert f"--light-distance {distance[0]:.1f} --object-width 1" in warning.text


def test_too_little_is_not_judged() -> None:
    few, black = scene("ball").observations[:30], np.zeros((400, 10))
    assert found(Sample(few, np.ones((5, 6), np.bool_), 1)) == []
    assert found(Sample(black, np.ones((20, 20), np.bool_), 1)) == []
    five = Sample(scene("relief", widths=3).observations[:, :5], np.ones((SIZE, SIZE), np.bool_), 1)
    assert encoded_values(five, LIGHTS[:5]) == [] == near_lamps(five, LIGHTS[:5])
