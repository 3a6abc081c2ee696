"""The material net, which predicts the gloss of each pixel from the tokens of the set branch.

The tokens already describe highlights, because they were trained to estimate normals in spite of
them. One further exchange of information with the other pixels of the capture is trained for
materials, since an object has few kinds of gloss, and each is visible only in pixels whose normals
reflect a light to the camera.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from splinecli.estimate.networks.set_branch import (
    ContextLayer,
    PixelTokens,
    Summary,
    brightness_level,
)
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import manifest, resolve_weights
from splinecli.system.weight_files import load_shipped

MATERIAL_FORMAT = "splinecli-material-net-1"

TOKEN_WIDTH = 64  # width of the tokens of the set branch
_HIDDEN = 192
_LEAST_ERROR = 0.02  # smallest error of a roughness


class Gloss(NamedTuple):
    """The gloss of P pixels, each (P,). Reflectances are relative to the pixel's largest
    observation.
    """

    roughness: Tensor
    roughness_error: Tensor  # expected absolute error
    metalness: Tensor  # the probability of a metal, or the share of metal in a mixture
    log_base: Tensor  # natural logarithm of the base
    log_base_error: Tensor  # expected absolute error
    # natural logarithm of the reflectance of a dielectric's facets at normal incidence
    log_level: Tensor
    minnaert: Tensor  # exponent of the diffuse light
    tail: Tensor  # exponent of the facets' distribution


class MaterialNet(nn.Module):
    """Predicts the gloss of pixels from their tokens and a sample of their capture's tokens."""

    def __init__(self) -> None:
        super().__init__()
        width = TOKEN_WIDTH
        self.embed = nn.Linear(width + 3, width)
        self.context = ContextLayer(width)
        self.perceptron = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU())
        self.mix = nn.Linear(2 * width, width)
        self.out = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, _HIDDEN), nn.GELU(), nn.Linear(_HIDDEN, 8)
        )

    def forward(
        self, pixels: PixelTokens, brightness: Tensor, known: Summary | None = None
    ) -> tuple[Gloss, Summary]:
        """Return the gloss, and the summary of the captures, which can be used for further pixels.

        Pixel p belongs to capture p % G, whose brightness (G,) is from CaptureContext. `known` is
        the summary of one capture. Without it, the pixels of each capture attend to each other.
        """
        level = brightness_level(pixels.scale, brightness)
        inputs = torch.cat((pixels.tokens, pixels.normal_z, level, pixels.n_lights.log()), dim=1)
        tokens, summary = self.context(self.embed(inputs), level, len(brightness), known)
        tokens = tokens + self.mix(self.perceptron(tokens))
        numbers = self.out(tokens).unbind(dim=1)
        gloss = Gloss(
            roughness=numbers[0].sigmoid(),
            roughness_error=softplus(numbers[1] - 2) + _LEAST_ERROR,
            metalness=numbers[2].sigmoid(),
            log_base=numbers[3],
            log_base_error=softplus(numbers[4] - 1) + _LEAST_ERROR,
            log_level=numbers[5] - 3,
            minnaert=1 + 0.5 * numbers[6].tanh(),
            tail=1.5 + 0.5 * numbers[7].tanh(),
        )
        return gloss, summary


def material_networks() -> tuple[SplineNet, MaterialNet]:
    """Return spline-net, whose tokens describe materials, and the material net. Raises
    ModelError.
    """
    shipped = manifest()["spline-net"]["material_net"]
    return resolve_weights("spline-net").network, load_shipped(
        MaterialNet(), shipped, MATERIAL_FORMAT
    ).float().eval()
