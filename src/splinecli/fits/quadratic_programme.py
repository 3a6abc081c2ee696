"""Solution of many small convex quadratic programmes at once, with non-negative variables."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["minimise_nonnegative"]


def minimise_nonnegative(hessian: Tensor, linear: Tensor, *, iterations: int = 100) -> Tensor:
    """Return the x >= 0 (P, K) that minimise x'Hx / 2 - q'x, for P programmes with a hessian H and a linear term q
    each.

    Block principal pivoting (Júdice and Pires 1994; the backup rule as in Kim and Park 2011, SIAM J. Sci. Comput.,
    algorithm 2): guess which variables are free, solve for them with the others at zero, and exchange those that
    violate x >= 0 or the sign of the gradient. Without rounding errors, this ends at the optimum.

    Args:
        hessian: (P, K, K), symmetric and positive definite.
        linear: (P, K).
        iterations: a limit, because rounding errors may cause cycles if a hessian is nearly singular. The result is
            then feasible and close to the optimum.
    """
    count, size = linear.shape
    eye = torch.eye(size, dtype=hessian.dtype, device=hessian.device)
    position = torch.arange(size, device=hessian.device)
    tolerance = 100 * torch.finfo(hessian.dtype).eps
    free = torch.ones_like(linear, dtype=torch.bool)
    fewest_wrong = linear.new_full((count,), size + 1)
    patience = linear.new_full((count,), 3)
    x = torch.zeros_like(linear)
    for _ in range(iterations):
        system = torch.where(free[:, :, None] & free[:, None, :], hessian, eye)
        right_side = torch.where(free, linear, 0)[..., None]
        x = torch.cholesky_solve(right_side, torch.linalg.cholesky(system))[..., 0]
        gradient = (hessian @ x[..., None])[..., 0] - linear
        value = torch.where(free, x, gradient)
        scale = torch.where(free, _largest(x), _largest(linear))
        wrong = value < -tolerance * scale
        wrong_count = wrong.sum(dim=1)
        if not wrong_count.any():
            break
        fewer = wrong_count < fewest_wrong
        fewest_wrong = torch.where(fewer, wrong_count, fewest_wrong)
        patience = torch.where(fewer, 3, patience - 1)
        # Exchanging all at once may cycle. After three exchanges without gain, exchange only the last one,
        # which cannot.
        last = torch.where(wrong, position, -1).amax(dim=1, keepdim=True)
        free = free ^ torch.where(patience[:, None] < 0, wrong & (position == last), wrong)
    return torch.where(free, x, 0).clamp(min=0)


def _largest(values: Tensor) -> Tensor:
    return values.abs().amax(dim=1, keepdim=True)
