"""The distribution of errors, against SciPy's; and that telling it changes no normal."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy import stats

from splinecli.networks.error_head import error_negative_log_likelihood, probability_within
from splinecli.networks.spline_net import SplineNet


@pytest.mark.parametrize(("median_deg", "shape"), [(0.5, 1.0), (4.0, 2.5), (30.0, 0.7)])
def test_a_log_logistic_distribution(median_deg: float, shape: float) -> None:
    error = torch.tensor([[math.log(math.radians(median_deg)), math.log(shape)]], dtype=torch.float64)
    expected = stats.fisk(shape, scale=median_deg)
    for limit_deg in (0.1, 5.0, 60.0):
        assert probability_within(error, limit_deg).item() == pytest.approx(expected.cdf(limit_deg + 0.1))
    angles_deg = np.array([0.3, 4.0, 50.0])
    # Of the angle's logarithm, a tenth of a degree added.
    found = error_negative_log_likelihood(error, torch.from_numpy(np.radians(angles_deg)))
    logistic = stats.logistic(math.log(median_deg), 1 / shape)
    np.testing.assert_allclose(found, -logistic.logpdf(np.log(angles_deg + 0.1)))


def test_it_changes_no_normal(random_network: Callable[..., SplineNet]) -> None:
    plain, telling = random_network(fits=["ls"]), random_network(fits=["ls"], error_head=True)
    telling.load_state_dict(plain.state_dict(), strict=False)
    generator = torch.Generator().manual_seed(1)
    lights = torch.nn.functional.normalize(torch.rand(9, 3, generator=generator) + 0.1, dim=1)
    observations = torch.rand(20, 9, generator=generator)
    with torch.inference_mode():
        normals, error = telling(observations, lights)
        assert torch.equal(plain(observations, lights).normals, normals)
        assert plain(observations, lights).error is None
        assert error is not None
        assert (error.shape, error.dtype) == ((20, 2), torch.float32)
        # It is of the pixel, not of its place in the capture's frame.
        turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        turned = telling(observations, lights @ turn.T).error
    torch.testing.assert_close(turned, error, atol=1e-4, rtol=0)
