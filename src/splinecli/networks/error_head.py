"""The error head: estimates the distribution of the angular error of NE-Net's normals, which gives confidence."""

import math

import torch
from torch import Tensor, nn

HIDDEN = 64


class ErrorHead(nn.Module):
    """Estimates a log-logistic distribution of the error (P, 2) from NE-Net's hidden features and its normals.

    The first number is the logarithm of the median error in radians, with _MORE_DEG added. The second is the logarithm
    of the distribution's shape: a larger shape means a narrower distribution. The other layers are fixed while this
    one is trained, so it does not change the normals.
    """

    def __init__(self, features: int, normals: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features + 3 * normals, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 2))

    def forward(self, features: Tensor, normals: Tensor) -> Tensor:
        """Estimate from features (P, C) and normals (P, K, 3): those of the fits, and the estimate before scaling."""
        error: Tensor = self.layers(torch.cat((features, normals.flatten(1).to(features.dtype)), dim=1))
        return error.float()


_MORE_DEG = 0.1  # Added to all errors. Without it, the logarithm would weigh differences between tiny errors.


def error_negative_log_likelihood(error: Tensor, angle: Tensor) -> Tensor:
    """Return minus the log-likelihood (P,) of the logarithms of errors (P,), in radians, under distributions (P, 2)."""
    median, shape = error.unbind(-1)
    z = shape.exp() * ((angle + math.radians(_MORE_DEG)).log() - median)
    return z + 2 * nn.functional.softplus(-z) - shape


def probability_within(error: Tensor, limit_deg: float) -> Tensor:
    """Return the probability (P,) that the error is at most limit_deg."""
    median, shape = error.unbind(-1)
    return torch.sigmoid(shape.exp() * (math.log(math.radians(limit_deg + _MORE_DEG)) - median))


def median_error_deg(error: Tensor) -> Tensor:
    """Return the medians (P,) of distributions (P, 2) in degrees."""
    return error[:, 0].exp().rad2deg() - _MORE_DEG
