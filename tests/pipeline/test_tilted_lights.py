"""Lights that are all tilted together, as the normals of a network show them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes import as_capture, cap_directions, parametrize, pinhole, sphere
from splinecli.estimate.inference import NormalEstimate
from splinecli.maths.normals import angle_between_deg
from splinecli.pipeline.infer import undo_tilt
from splinecli.records.capture_warnings import CURVE_MENDED, LIGHTS_TILTED, CaptureWarning

LIGHTS = cap_directions(10, 50, 3, even=True)
NORMALS, INSIDE = sphere(64)
TILT = Rotation.from_rotvec(np.radians((0, 18, 0)))


def capture(lights, **fields):
    return as_capture((NORMALS[INSIDE] @ LIGHTS.T).clip(0), lights, INSIDE, **fields)


def network(confidence, follows=1.0):
    """Return a network whose normals follow a tilt of the lights in part, with this confidence by
    its angle.
    """

    def estimate(of):
        turn, _ = Rotation.align_vectors(of.light_directions, LIGHTS)
        part = Rotation.from_rotvec(follows * turn.as_rotvec())
        normals = np.where(
            INSIDE[..., None], part.apply(NORMALS.reshape(-1, 3)).reshape(64, 64, 3), 0
        )
        off_deg = float(np.degrees(turn.magnitude()))
        sure = np.float32(np.where(INSIDE, confidence(off_deg), 0))
        return NormalEstimate(of, np.float32(normals), 0.0, confidence_map=sure)

    return estimate


@parametrize("follows", [1.0, 0.7])
def test_lights_are_tilted_back_in_steps(follows):
    again, given = network(lambda off_deg: 0.9, follows), capture(TILT.apply(LIGHTS))
    given = replace(given, mended=(CURVE_MENDED.code,))
    found, (warning,) = undo_tilt(again(given), again, mends=True)
    assert angle_between_deg(found.capture.light_directions, LIGHTS).max() < 5.5  # of 18
    assert found.capture.mended == (CURVE_MENDED.code, LIGHTS_TILTED.code)
    assert warning.code == "lights_mended" and "--light-frame x-right,y-up" in warning.text


def test_lights_that_an_option_gives_are_only_doubted():
    again, given = network(lambda off_deg: 0.9), capture(TILT.apply(LIGHTS))
    found, (warning,) = undo_tilt(again(given), again, mends=False)
    assert warning.kind is LIGHTS_TILTED and warning.error_deg == pytest.approx(18, abs=3)
    assert found.capture.warnings == (warning,)  # which lowers the confidence
    np.testing.assert_array_equal(found.capture.light_directions, given.light_directions)


def test_a_tilt_that_the_network_contradicts_is_not_named():
    """It is surer under the given lights, as under those of an object that only looks tilted."""
    again, given = network(lambda off_deg: min(0.9, 0.02 * off_deg)), capture(TILT.apply(LIGHTS))
    assert undo_tilt(again(given), again, mends=True)[1] == []


def test_right_lights_and_lights_from_the_images_stay():
    again, warning = network(lambda off_deg: 0.9), CaptureWarning(LIGHTS_TILTED, "Tilted.")
    for kept in (
        capture(LIGHTS, warnings=(warning,)),
        capture(TILT.apply(LIGHTS), light_errors_deg=np.ones(10)),
        capture(TILT.apply(LIGHTS), camera_matrix=pinhole(90, 32, 32)),
    ):
        before = again(kept)
        assert undo_tilt(before, again, mends=True) == (before, [])
