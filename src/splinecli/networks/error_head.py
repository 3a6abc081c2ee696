"""The error head, which estimates the angular error of NE-Net's normals for the confidence, and the capture head, which
changes these errors by what a capture as a whole says."""

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


PIXEL_FEATURES, CAPTURE_FEATURES = 2, 20  # numbers of features of confidence.py
_BEND_TURN = 11  # the place of CaptureFeatures.bend_turn
_CAPTURE_HIDDEN = 24
_MOST = 4.0  # standard deviations of a feature from its mean
_INPUTS = 2 + PIXEL_FEATURES + CAPTURE_FEATURES
_NO_ERROR = -3.5  # logarithm of the median error, in radians, that is added before training


class CaptureHead(nn.Module):
    """Changes log-logistic distributions of errors (P, 2), whose two numbers ErrorHead describes.

    Wrong lights and values add an error of their own, whatever the network expects. The new median is therefore the
    scaled old one, plus one that the features give, plus a share of the turn by encoded values. The head is small on
    purpose: it learned from hundreds of captures only.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, hidden: int = _CAPTURE_HIDDEN) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(_INPUTS))
        self.register_buffer("spread", torch.ones(_INPUTS))
        self.hidden = nn.Linear(_INPUTS, hidden)
        self.last = nn.Linear(hidden, 3)
        self.linear = nn.Linear(_INPUTS, 3)
        self.bend = nn.Parameter(torch.tensor(math.log(0.6)))
        for layer in (self.last, self.linear):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        with torch.no_grad():
            self.linear.bias[1] = _NO_ERROR

    def forward(self, errors: Tensor, pixels: Tensor, capture: Tensor) -> Tensor:
        """Return the changed distributions (P, 2).

        Args:
            errors: (P, 2), distributions of the errors.
            pixels: (P, 2), features of the pixels.
            capture: (20,) or (P, 20), features of the capture, in the order of CaptureFeatures. NaN is unknown.
        """
        inputs = torch.cat((errors, pixels, capture.expand(len(errors), -1)), dim=1)
        inputs = ((inputs - self.mean) / self.spread).nan_to_num(0.0).clamp(-_MOST, _MOST)
        found = self.linear(inputs) + self.last(self.hidden(inputs).tanh())
        median = torch.logaddexp(errors[:, 0] + found[:, 0], found[:, 1])
        # However well all else fits: encoded values turn the normals by about so much.
        bent = capture[..., _BEND_TURN] + math.log(math.pi / 180) + self.bend
        median = torch.logaddexp(median, bent.expand(len(errors)))
        return torch.stack((median, errors[:, 1] + found[:, 2]), dim=1)
