"""The batched solver, against SciPy's non-negative least squares and the conditions of an optimum."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from splinecli.fits.quadratic_programme import minimise_nonnegative


@pytest.mark.parametrize("rows", [30, 7], ids=["well determined", "nearly singular"])
def test_optimum_is_scipys(rows: int) -> None:
    rng = np.random.default_rng(0)
    # Columns alike make for many exchanges; with 7 rows for 10 unknowns the ridge alone makes the optimum unique.
    matrices = rng.uniform(size=(100, rows, 10))
    ridge = np.broadcast_to(1e-4 * np.eye(10), (100, 10, 10))
    matrices = np.concatenate((matrices, ridge), axis=1)
    signal = (matrices @ rng.uniform(-0.3, 1, size=(100, 10, 1)))[..., 0]
    targets = signal + np.concatenate((0.1 * rng.normal(size=(100, rows)), np.zeros((100, 10))), axis=1)
    hessian, linear = matrices.mT @ matrices, (matrices.mT @ targets[..., None])[..., 0]
    found = minimise_nonnegative(torch.as_tensor(hessian), torch.as_tensor(linear)).numpy()
    expected = np.stack([nnls(a, b)[0] for a, b in zip(matrices, targets, strict=True)])
    assert 0.2 < (expected == 0).mean() < 0.8
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    gradient = (hessian @ found[..., None])[..., 0] - linear
    assert found.min() >= 0
    assert gradient.min() > -1e-9
    assert np.abs(gradient * found).max() < 1e-9


def test_independent_variables_are_clamped() -> None:
    linear = torch.tensor([[1.0, -2.0, 3.0], [-1.0, -1.0, -1.0]], dtype=torch.float64)
    hessian = torch.diag(torch.tensor([1.0, 2.0, 6.0], dtype=torch.float64)).expand(2, 3, 3)
    torch.testing.assert_close(
        minimise_nonnegative(hessian, linear),
        torch.tensor([[1.0, 0.0, 0.5], [0.0, 0.0, 0.0]], dtype=torch.float64),
    )


def test_no_programmes() -> None:
    assert minimise_nonnegative(torch.zeros(0, 3, 3), torch.zeros(0, 3)).shape == (0, 3)
