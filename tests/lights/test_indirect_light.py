"""Light from other parts of the object: a spherical bowl, in which it is known exactly.

Two parts of a sphere's inside exchange the same share of light wherever they are. So in a matte
bowl of radius R, all places receive the same indirect light, sum(B dA) / (4 pi R^2), where B is
what the places send.
"""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import torch
from pytest import approx

from scenes import directions_at, parametrize, pinhole
from splinecli.capture import Capture
from splinecli.capture.near_lamps import NearLamps
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.estimate.networks.refine_net import channels
from splinecli.estimate.refinement.refiner import NetworkRefiner
from splinecli.lights import lighting
from splinecli.lights.lighting import PixelLighting, find_indirect_light
from splinecli.maths.normals import angle_between_deg
from splinecli.workshop.training.refinement import pixel_features

SIZE = 64
AZIMUTH = np.arange(10) * np.radians(36)
ZENITH = np.radians(np.where(np.arange(10) % 2, 35, 60))
LIGHTS = directions_at(AZIMUTH, ZENITH)
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]
X, Y = (COLUMNS - (SIZE - 1) / 2) / (SIZE / 2), ((SIZE - 1) / 2 - ROWS) / (SIZE / 2)
MASK = X**2 + Y**2 < 0.9**2
OUTWARDS = np.stack((X, Y, np.sqrt((1 - X**2 - Y**2).clip(0))), axis=-1)[MASK]
"""The normals of a ball. Those of a bowl have the opposite x and y."""
BOWL = OUTWARDS * (-1, -1, 1)
ALBEDO = np.where((ROWS // 8 + COLUMNS // 8) % 2, 0.9, 0.3)[MASK][:, None]
SHARE = 1 / OUTWARDS[:, 2:] / (4 * np.pi * (SIZE / 2) ** 2)
"""The share (P, 1) of each pixel in the area of the whole sphere."""
EVERYWHERE = np.arange(len(BOWL))
INSIDE = np.hypot(X, Y)[MASK] < 0.8
"""The pixels but for the rim, which lies between a block and none."""


def direct_and_indirect(
    normals,
    directions=LIGHTS,
    strengths=1.0,
):
    """Return the light (P, F) that a checkered matte bowl reflects from the lamps,
    and from itself.
    """
    direct = ALBEDO * (normals[:, None] * directions).sum(-1).clip(0) * strengths
    arriving = (SHARE * direct).sum(axis=0) / (1 - (SHARE * ALBEDO).sum())
    return np.float32(direct), np.float32(ALBEDO * arriving)


DIRECT, INDIRECT = direct_and_indirect(BOWL)
CAPTURE = Capture("bowl", DIRECT + INDIRECT, LIGHTS, tuple(range(10)), MASK)


def found_in(normals, observations, lights=LIGHTS):
    return find_indirect_light(
        MASK,
        observations,
        lambda rows: PixelLighting(observations[rows], lights),
        np.float32(normals),
    )


def test_a_bowls_light_on_itself_is_found_at_any_exposure():
    direct, indirect = 5 * DIRECT, 5 * INDIRECT
    found = found_in(BOWL, direct + indirect)
    ratio = (found.at(EVERYWHERE) / indirect)[INSIDE]
    assert ratio.mean() == approx(1, abs=0.05)
    assert ratio.std() < 0.05
    left = found.remove(direct + indirect, EVERYWHERE)
    assert np.abs(left - direct)[INSIDE].mean() < 0.1 * indirect.mean()


def test_only_every_third_normal_is_read(monkeypatch):
    monkeypatch.setattr(lighting, "LIT_AT_ONCE", 100)
    normals, seen = np.full_like(BOWL, np.nan), DIRECT + INDIRECT
    normals[::3] = BOWL[::3]

    def lighting_at(rows):
        return PixelLighting(seen[rows], LIGHTS)

    found = find_indirect_light(MASK, seen, lighting_at, np.float32(normals), known=3)
    assert (found.at(EVERYWHERE) / INDIRECT)[INSIDE].mean() == approx(1, abs=0.05)


@parametrize("camera_matrix", [None, pinhole(200, 31.5, 31.5)])
def test_it_is_found_under_near_lamps(camera_matrix):
    points = np.stack((X[MASK], Y[MASK], -BOWL[:, 2]), axis=1)
    points[:, 2] -= points[:, 2].mean()
    distances = np.where(np.arange(10) % 2, 3.0, 2.0)[:, None]
    lamps = NearLamps.of(
        distances * LIGHTS, 2 / SIZE, (SIZE, SIZE), equal=False, camera_matrix=camera_matrix
    )
    lamps = replace(lamps, points=np.float32(points))
    direct, indirect = direct_and_indirect(BOWL, *lamps.light_at(points))
    seen = direct + indirect

    def lighting_at(rows):
        return PixelLighting.of(seen[rows], lamps.choose_pixels(rows))

    found = find_indirect_light(MASK, seen, lighting_at, np.float32(BOWL))
    assert (found.at(EVERYWHERE) / indirect)[INSIDE].mean() == approx(1, abs=0.05)


def test_a_dark_background_changes_nothing():
    alone = found_in(BOWL, DIRECT + INDIRECT)
    mask = np.ones((640, 640), np.bool_)
    normals = np.tile(np.array((0, 0, 1), np.float32), (*mask.shape, 1))
    observations = np.full((*mask.shape, 10), 0.002, np.float32)
    place = np.zeros_like(mask)
    place[320:384, 320:384] = MASK
    normals[place], observations[place] = BOWL, DIRECT + INDIRECT
    normals, observations = normals[mask], observations[mask]
    found = find_indirect_light(
        mask, observations, lambda rows: PixelLighting(observations[rows], LIGHTS), normals
    )
    ratio = found.at(np.flatnonzero(place)) / alone.at(EVERYWHERE)
    assert ratio[INSIDE].mean() == approx(1, abs=0.05)


def test_a_ball_receives_none_even_with_ambient_light():
    direct = direct_and_indirect(OUTWARDS)[0]
    assert found_in(OUTWARDS, direct) is None
    assert found_in(OUTWARDS, direct + np.float32(0.05)) is None


def test_ambient_light_is_separated_from_indirect_light():
    found = found_in(BOWL, DIRECT + INDIRECT + np.float32(0.03 * ALBEDO))
    assert (found.at(EVERYWHERE) / INDIRECT)[INSIDE].mean() == approx(1, abs=0.15)


def test_nothing_is_removed_where_shadows_do_not_show_it(rng):
    """Black shadows, as in a bowl that reflects into one direction only; and shadows that follow
    something else.
    """
    assert found_in(BOWL, DIRECT) is None
    noise = rng.random(DIRECT.shape, np.float32) / np.float32(ALBEDO)
    assert found_in(BOWL, np.where(DIRECT > 0, DIRECT, INDIRECT * noise)) is None
    assert found_in(BOWL, np.zeros_like(DIRECT)) is None


def test_no_more_is_removed_than_the_brightest_albedo_allows():
    assert 1.3 < found_in(BOWL, DIRECT + 20 * INDIRECT).albedo.max() < 1.6


def test_shipped_weights_estimate_a_bowl_better_without_its_own_light():
    estimator = make_estimator("spline-net")

    def mean_error_deg():
        found = estimate_normals(CAPTURE, estimator).normal_map[MASK]
        return float(angle_between_deg(found, BOWL).mean())

    without = mean_error_deg()
    with patch.object(lighting, "find_indirect_light", return_value=None):
        assert without < 0.6 * mean_error_deg()


def test_the_refinement_net_learns_from_what_it_sees_in_use():
    estimator = make_estimator("spline-net")
    features = pixel_features(
        estimator.network,  # type: ignore[attr-defined]
        torch.from_numpy(CAPTURE.observations),
        torch.from_numpy(LIGHTS).float(),
        torch.tensor(MASK),
    )
    with patch.object(NetworkRefiner, "refine"):
        in_use = estimate_normals(CAPTURE, estimator).normal_map[MASK]
    learned_from = features[:, channels("normal")].numpy()
    assert angle_between_deg(learned_from, in_use).max() < 0.1
    bound = estimator.bind(lambda rows: PixelLighting(CAPTURE.observations[rows], LIGHTS), MASK)
    with_indirect = bound.estimate(CAPTURE.observations, LIGHTS)
    assert angle_between_deg(learned_from, with_indirect).mean() > 1
