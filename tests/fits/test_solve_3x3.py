"""The closed-form 3 x 3 solutions, compared with LAPACK's."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splinecli.fits.robust import inverse_3x3, multiply_symmetric

ROWS, COLUMNS = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
"""Places of xx, yy, zz, xy, xz, yz in a matrix."""


def positive_matrices(count: int, rank: int = 3) -> NDArray[np.float64]:
    factors = np.random.default_rng(0).normal(size=(count, 3, rank))
    return np.asarray(factors @ factors.transpose(0, 2, 1))


def inverse(matrices: NDArray[Any], smallest: float, library: str) -> NDArray[Any]:
    entries: list[Any] = [matrices[:, i, j] for i, j in zip(ROWS, COLUMNS, strict=True)]
    if library == "torch":
        entries = [torch.from_numpy(entry) for entry in entries]
    result = np.empty_like(matrices)
    for i, j, entry in zip(ROWS, COLUMNS, inverse_3x3(entries, smallest), strict=True):
        result[:, i, j] = result[:, j, i] = np.asarray(entry)
    return result


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_inverse(library: str) -> None:
    matrices = positive_matrices(1000)
    expected = np.linalg.inv(matrices)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    # The worst of a thousand such matrices has a condition number of about 1e7.
    np.testing.assert_allclose(inverse(matrices, 1e-14, library) / size, expected / size, atol=1e-8)


def test_numpy_and_torch_agree_to_the_last_bit() -> None:
    matrices = positive_matrices(1000)
    assert inverse(matrices, 1e-12, "numpy").tobytes() == inverse(matrices, 1e-12, "torch").tobytes()


@pytest.mark.parametrize("rank", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_inverse_of_a_singular_matrix_is_positive(rank: int, dtype: type) -> None:
    inverted = inverse(positive_matrices(100, rank).astype(dtype), 1e-6, "numpy")
    assert np.isfinite(inverted).all()
    assert (np.diagonal(inverted, axis1=1, axis2=2) > 0).all()


def test_product_with_a_vector() -> None:
    matrices, vectors = positive_matrices(50), np.random.default_rng(1).normal(size=(50, 3))
    entries = [matrices[:, i, j] for i, j in zip(ROWS, COLUMNS, strict=True)]
    found, expected = multiply_symmetric(entries, vectors.T), np.einsum("pij,pj->ip", matrices, vectors)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
