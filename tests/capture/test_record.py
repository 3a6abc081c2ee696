"""The record: what it refuses, and choosing lights."""

from typing import Any

import numpy as np
import pytest

from splinecli.capture import Capture
from splinecli.errors import InputError, UsageError

LIGHTS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.48, -0.36, 0.8]])
MASK = np.array([[True, False, True], [True, True, False]])


def make(**changes: Any) -> Capture:
    fields: dict[str, Any] = {"name": "vase", "observations": np.arange(16).reshape(4, 4), "mask": MASK}
    return Capture(**(fields | {"light_directions": LIGHTS, "light_indices": (0, 1, 2, 7)} | changes))


def test_positions_that_cannot_be_meant() -> None:
    for positions, message in (
        ([0, 1, -1], "light index -1 is out of range"),
        ([0, 1, 2, 1], "light index 1 is listed twice. Name each light once."),
        ([0, 1], "2 lights chosen, expected at least 3."),
    ):
        with pytest.raises(UsageError, match=message):
            make().choose_lights(positions)


NO_NORMAL = "a ground-truth normal is neither a unit vector nor zero"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": np.zeros((5, 4))}, r"observations of shape \(5, 4\), expected .* = \(4, 4\)"),
        ({"observations": np.full((4, 4), np.nan)}, "an observation is not finite"),
        ({"light_directions": LIGHTS[:, :2]}, r"light directions of shape \(4, 2\), expected \(F, 3\)"),
        ({"light_indices": (0, 1, 2)}, "3 light indices for 4 lights"),
        ({"light_directions": LIGHTS * 1.01}, "a light direction is not a unit vector"),
        ({"light_directions": LIGHTS * np.nan}, "a light direction is not finite"),
        ({"light_directions": LIGHTS * [1, 1, -1]}, r"light 0 is below the horizon \(z <= 0\)"),
        ({"mask": np.zeros((2, 3), bool)}, "the mask is empty"),
        ({"mask": np.ones(4, bool)}, r"a mask of shape \(4,\), expected \(H, W\)"),
        ({"ground_truth": np.zeros((3, 2, 3))}, r"ground truth of shape \(3, 2, 3\), expected .* \(2, 3, 3\)"),
        ({"ground_truth": np.full((2, 3, 3), 0.1)}, NO_NORMAL),
        ({"ground_truth": np.full((2, 3, 3), np.nan)}, NO_NORMAL),
    ],
)
def test_fields_that_do_not_fit(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"vase: {message}"):
        make(**changes)


def test_restored_observations_follow_the_choice() -> None:
    restored = np.arange(16).reshape(4, 4) % 3 == 0
    capture = make(restored=restored)
    np.testing.assert_array_equal(capture.choose_lights([3, 0, 2]).restored, restored[:, [3, 0, 2]])
    chosen = capture.choose_pixels(np.array([0, 3]))
    np.testing.assert_array_equal(chosen.restored, restored[[0, 3]])
    np.testing.assert_array_equal(chosen.observations, capture.observations[[0, 3]])
    np.testing.assert_array_equal(chosen.mask, [[True, False, False], [False, True, False]])
    assert make().choose_lights([0, 1, 2]).restored is None
    with pytest.raises(InputError, match=r"vase: restored flags of shape \(4, 3\), expected .* = \(4, 4\)"):
        make(restored=restored[:, :3])
