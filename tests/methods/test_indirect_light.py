"""Light from other parts of the object: a spherical bowl, in which it is known exactly.

Two parts of a sphere's inside exchange the same share of light wherever they are. So in a matte bowl of area A and
radius R, all places receive the same indirect light, sum(B dA) / (4 pi R^2), where B is what the places send.
"""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli import inference
from splinecli.capture import Capture
from splinecli.inference import estimate_normals
from splinecli.methods import make_estimator
from splinecli.methods.indirect_light import IndirectLight, find_indirect_light
from splinecli.methods.lamp_light import LampLight
from splinecli.normals import angle_between_deg

SIZE = 64
AZIMUTH = np.arange(10) * np.radians(36)
ZENITH = np.radians(np.where(np.arange(10) % 2, 35, 60))
LIGHTS = np.stack(
    (np.sin(ZENITH) * np.cos(AZIMUTH), np.sin(ZENITH) * np.sin(AZIMUTH), np.cos(ZENITH)), axis=1
)
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]
X, Y = (COLUMNS - (SIZE - 1) / 2) / (SIZE / 2), ((SIZE - 1) / 2 - ROWS) / (SIZE / 2)
MASK = X**2 + Y**2 < 0.9**2
OUTWARDS = np.stack((X, Y, np.sqrt((1 - X**2 - Y**2).clip(0))), axis=-1)[MASK]
"""The normals of a ball. Those of a bowl have the opposite x and y."""
BOWL = OUTWARDS * (-1, -1, 1)
ALBEDO = 0.7


def direct_and_indirect(
    normals: NDArray[np.floating], *, exposure: float = 1.0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the light (P, F) that a matte bowl reflects from the lamps, and from itself."""
    direct = ALBEDO * (normals @ LIGHTS.T).clip(0)
    share = (
        1 / OUTWARDS[:, 2:] / (4 * np.pi * (SIZE / 2) ** 2)
    )  # of each pixel in the area of the whole sphere
    indirect = ALBEDO * (share * direct).sum(axis=0) / (1 - ALBEDO * share.sum())
    return (exposure * direct).astype(np.float32), np.broadcast_to(exposure * indirect, direct.shape).astype(
        np.float32
    )


def found_in(
    normals: NDArray[np.floating], observations: NDArray[np.float32], falloff: float = 1.0
) -> IndirectLight | None:
    return find_indirect_light(
        MASK,
        observations,
        lambda rows: LampLight(observations[rows] / np.float32(falloff), LIGHTS),
        normals.astype(np.float32),
    )


@pytest.mark.parametrize(("exposure", "falloff"), [(1.0, 1.0), (5.0, 1.0), (1.0, 0.5)])
def test_a_bowls_light_on_itself_is_found_at_any_exposure(exposure: float, falloff: float) -> None:
    direct, indirect = direct_and_indirect(BOWL, exposure=exposure)
    found = found_in(BOWL, direct + indirect, falloff)
    assert found is not None
    everywhere = np.arange(len(BOWL))
    inside = np.hypot(*BOWL[:, :2].T) < 0.8  # the rim lies between a block and none
    ratio = (found.at(everywhere) / indirect)[inside]
    assert ratio.mean() == pytest.approx(1, abs=0.1)
    assert ratio.std() < 0.1
    assert found.counts_at(direct + indirect, everywhere)[inside].all()
    left = found.remove(direct + indirect, everywhere)
    assert np.abs(left - direct)[inside].mean() < 0.15 * indirect.mean()


def test_a_ball_receives_none_even_with_ambient_light() -> None:
    direct, _ = direct_and_indirect(OUTWARDS)
    assert found_in(OUTWARDS, direct) is None
    assert found_in(OUTWARDS, direct + np.float32(0.05)) is None


def test_ambient_light_is_not_taken_for_indirect_light() -> None:
    direct, indirect = direct_and_indirect(BOWL)
    ambient = np.float32(0.05 * ALBEDO)
    found = found_in(BOWL, direct + indirect + ambient)
    assert found is None or float(found.at(np.arange(len(BOWL))).mean()) < 1.5 * indirect.mean()


def test_nothing_is_removed_where_shadows_do_not_show_it() -> None:
    """Black shadows, as in a bowl that reflects into one direction only; and shadows that follow something else."""
    direct, indirect = direct_and_indirect(BOWL)
    assert found_in(BOWL, direct) is None
    noise = np.random.default_rng(0).random(direct.shape, np.float32)
    assert found_in(BOWL, np.where(direct > 0, direct, 2 * indirect * noise)) is None


def test_shipped_weights_estimate_a_bowl_better_without_its_own_light() -> None:
    direct, indirect = direct_and_indirect(BOWL)
    capture = Capture("bowl", direct + indirect, LIGHTS, tuple(range(10)), MASK)
    estimator = make_estimator("spline-net")

    def mean_error_deg() -> float:
        found = estimate_normals(capture, estimator).normal_map[MASK]
        return float(angle_between_deg(found, BOWL).mean())

    without = mean_error_deg()
    with patch.object(inference, "find_indirect_light", return_value=None):
        assert without < 0.6 * mean_error_deg()
