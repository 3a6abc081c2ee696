"""How far off NE-Net's normals are likely to be: the distribution of a pixel's angular error, and confidence."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

HIDDEN = 64


class ErrorHead(nn.Module):
    """NE-Net's hidden features (P, C) and its normals -> a log-logistic distribution of the error (P, 2).

    The first number is the logarithm of the median error in radians (_MORE_DEG added), the second that of the
    distribution's shape: the larger, the surer. The networks are fixed while this is trained, so that it costs the
    normals nothing.
    """

    def __init__(self, features: int, normals: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(features + 3 * normals, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 2)
        )

    def forward(self, features: Tensor, normals: Tensor) -> Tensor:
        """Features (P, C); normals (P, K, 3): of the fits, and the estimate before it gets unit length."""
        error: Tensor = self.layers(torch.cat((features, normals.flatten(1).to(features.dtype)), dim=1))
        return error.float()


_MORE_DEG = 0.1
"""Added to all errors: nobody needs to know that one is a hundredth of a degree and not a thousandth."""


def error_surprise(error: Tensor, angle: Tensor) -> Tensor:
    """Minus the log-likelihood (P,) of the logarithms of errors (P,) in radians under distributions (P, 2)."""
    median, shape = error.unbind(-1)
    z = shape.exp() * ((angle + math.radians(_MORE_DEG)).log() - median)
    return z + 2 * nn.functional.softplus(-z) - shape


def probability_within(error: Tensor, limit_deg: float) -> Tensor:
    """The probability (P,) that a pixel's normal is off by no more than so many degrees."""
    median, shape = error.unbind(-1)
    return torch.sigmoid(shape.exp() * (math.log(math.radians(limit_deg + _MORE_DEG)) - median))
