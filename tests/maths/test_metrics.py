"""Angular errors."""

import numpy as np
import pytest

from splinecli.maths.normals import angular_error_map_deg, summarise_errors


def tilted(degrees: float) -> list[float]:
    return [float(np.sin(np.radians(degrees))), 0.0, float(np.cos(np.radians(degrees)))]


def test_error_map() -> None:
    truth = np.array([[[0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 1]]], np.float32)
    normals = np.array([[tilted(30), [0, 0, -1], [0, 0, 1], [0, 0, 1]]], np.float32)
    errors = angular_error_map_deg(normals, truth, np.array([[True, True, True, False]]))
    # Right by definition; flipped is 180, not 0; no truth; outside the mask.
    np.testing.assert_allclose(errors, [[30, 180, np.nan, np.nan]], atol=1e-5)


def test_summary_of_a_known_list() -> None:
    errors = summarise_errors(np.array([np.nan, *range(11), np.nan]))
    # 0, 1, ... 10: mean and median 5, the ninth tenth at 9; five of eleven under 5, ten under 10.
    assert (errors.mean, errors.median, errors.p90) == (5, 5, 9)
    assert errors.under_5 == pytest.approx(5 / 11)
    assert errors.under_10 == pytest.approx(10 / 11)


def test_float32_maps_are_summed_in_float64() -> None:
    errors = summarise_errors(np.full(10_000_000, 0.1, np.float32))
    assert errors.mean == pytest.approx(float(np.float32(0.1)), rel=1e-9)


def test_nothing_to_summarise() -> None:
    assert summarise_errors(np.full((3, 3), np.nan, np.float32)) is None
    assert summarise_errors(np.array([])) is None
