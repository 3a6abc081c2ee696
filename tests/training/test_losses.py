"""The losses, at values that are known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from splinecli.training.losses import angular_loss, map_loss, masked_map_loss


def at(degrees: float) -> Tensor:
    angle = math.radians(degrees)
    return torch.tensor([[math.sin(angle), 0.0, math.cos(angle)]], dtype=torch.float64)


# A sine of 1e-6 stands in for zero, so that the gradient is bounded: 6e-5 degrees.
@pytest.mark.parametrize("degrees", [0.0, 0.01, 10.0, 90.0, 179.0, 180.0])
def test_angle(degrees: float) -> None:
    assert math.degrees(angular_loss(at(degrees), at(0)).item()) == pytest.approx(degrees, abs=6e-5)


def test_angle_is_the_mean_over_pixels() -> None:
    normals = torch.cat((at(10), at(-30), at(80)))
    assert math.degrees(angular_loss(normals, at(0).expand(3, 3)).item()) == pytest.approx(40, abs=6e-5)


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 10.0, 180.0])
def test_gradient_of_the_angle_is_finite_and_at_most_one(degrees: float) -> None:
    normals = at(degrees).requires_grad_()
    angular_loss(normals, at(0)).backward()
    assert normals.grad is not None
    assert torch.isfinite(normals.grad).all()
    assert normals.grad.norm() <= 1 + 1e-9
    if degrees == 10:
        # An angle grows by one along the circle.
        tangent = torch.tensor(
            [[math.cos(math.radians(10)), 0, -math.sin(math.radians(10))]], dtype=torch.float64
        )
        assert (normals.grad * tangent).sum().item() == pytest.approx(1)


def test_map_loss_is_the_mean_inside_the_disc() -> None:
    inside = torch.zeros(1, 1, 4, 4)
    inside[..., 1:3, 1:3] = 1
    truth = torch.rand(2, 1, 4, 4, generator=torch.Generator().manual_seed(0))
    dense = truth + 0.3
    dense[0, 0, 1, 1] = truth[0, 0, 1, 1] - 0.7
    dense[1, 0, 0, 0] = 1e6  # outside
    # Seven cells of eight are off by 0.3 and one by 0.7.
    assert map_loss(dense, truth, inside).item() == pytest.approx((7 * 0.3 + 0.7) / 8)
    assert map_loss(truth, truth, inside) == 0


def test_masked_map_loss_is_the_mean_over_observed_cells() -> None:
    holds, truth = torch.zeros(2, 1, 4, 4), torch.zeros(2, 1, 4, 4)
    holds[0, 0, 0, 1] = holds[0, 0, 2, 2] = holds[1, 0, 3, 3] = 1
    dense = torch.full((2, 1, 4, 4), 5.0)
    dense[0, 0, 0, 1], dense[0, 0, 2, 2], dense[1, 0, 3, 3] = 0.1, -0.2, 0.6
    assert masked_map_loss(dense, truth, holds).item() == pytest.approx(0.3)
    assert masked_map_loss(dense, truth, torch.zeros(2, 1, 4, 4)) == 0
