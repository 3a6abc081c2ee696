"""The set branch: attention over the raw observations of a pixel and over the other pixels of its
capture.

Ten observations are consistent with many pairs of a normal and a reflectance. An object has few
materials, and pixels with other normals sample the same reflectance at other angles. Universal
photometric stereo (Ikehata, CVPR 2022 and 2023) demonstrates the benefit of communication between
pixels. Here each pixel attends to the tokens of a sample of its capture.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import normalize, scaled_dot_product_attention

from splinecli.estimate.fits.least_squares import direction_products, weighted_sum
from splinecli.estimate.networks.config import HEAD_WIDTH
from splinecli.estimate.networks.li_ne_net import AT_ONCE, zeroed
from splinecli.maths import Floats
from splinecli.maths.pixel_grid import slices
from splinecli.maths.robust import inverse_3x3, lit_values, multiply_symmetric

SAMPLE = 512  # number of pixels of a capture that all its pixels attend to


class Summary(NamedTuple):
    """The summary of G captures in one layer, from S pixels of each."""

    keys: Tensor  # keys, values: (G, heads, S, width / heads)
    values: Tensor
    mean: Tensor  # (G, 1, width)


class CaptureContext(NamedTuple):
    """Information about a capture that is shared by its pixels."""

    brightness: Tensor  # (1,), median of the largest observation of the sampled pixels
    layers: tuple[Summary, ...]  # one for each layer of the set branch


class ScaledPixels(NamedTuple):
    """The inputs of the set branch: P pixels, each divided by its largest observation."""

    observed: Tensor  # (P, F)
    lights: Tensor  # (P, F, 3), unit, in the pixels' frames
    residuals: Tensor  # (P, F), of the robust Lambertian fit
    valid: Tensor | None  # (P, F) bool, or None for all
    normals: Tensor  # (P, K, 3), the starting normals, unit or zero
    scale: Tensor  # (P, 1), the largest observations


class PixelTokens(NamedTuple):
    """The tokens of P pixels, and the numbers that they are relative to; see
    SplineNet.encode_pixels.
    """

    tokens: Tensor  # (P, width)
    normal_z: Tensor  # (P, 1), of the fitted normals
    scale: Tensor  # (P, 1), the largest observation of each pixel
    n_lights: Tensor  # (P, 1), the number of lights


def sample_of(observations: Floats) -> NDArray[np.intp]:
    """Choose the sample of pixels that all pixels of a capture attend to, and return their rows in
    (P, F).

    These are at most SAMPLE lit pixels, evenly spaced. If no pixel is lit, the first one is used.
    """
    pixels, _ = lit_values(observations, 0.02, SAMPLE)  # a black background carries no information
    return pixels if len(pixels) else np.zeros(1, np.intp)


def brightness_level(largest: Tensor, brightness: Tensor) -> Tensor:
    """Return the logarithm (P, 1) of the largest observation of each pixel (P, 1) over its
    capture's brightness (G,).

    Pixel p belongs to capture p % G.
    """
    levels = largest.view(-1, len(brightness)) / brightness.clamp(min=1e-9)
    return levels.clamp(min=1e-9).log().clamp(-7.0, 7.0).view(-1, 1)


class ContextLayer(nn.Module):
    """Adds information from the tokens of a capture to the tokens of its pixels, by attention and
    as a mean.

    Initially, it adds nothing.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embed = nn.Linear(width + 1, width)
        self.query_norm, self.key_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries = nn.Linear(width, width)
        self.keys_values = nn.Linear(width, 2 * width)
        self.pooled = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )
        self.join = nn.Sequential(
            nn.Linear(3 * width, 2 * width), nn.GELU(), zeroed(nn.Linear(2 * width, width))
        )

    def forward(
        self, tokens: Tensor, level: Tensor, captures: int, known: Summary | None
    ) -> tuple[Tensor, Summary]:
        """Return the updated tokens (P, width), and the summary of their captures.

        For the level (P, 1), see brightness_level. Pixel p belongs to capture p % `captures`.
        `known` is the summary of one capture; None uses the pixels themselves as the samples of
        their captures.
        """
        embedded = self.embed(torch.cat((tokens, level), dim=1))
        embedded = embedded.view(-1, captures, tokens.shape[1]).transpose(0, 1)
        summary = self._summarise(embedded) if known is None else known
        queries = self.query_norm(embedded)
        with torch.autocast(tokens.device.type, enabled=False):
            # Use float32, as in the set branch.
            asked = _split(self.queries(queries.to(self.queries.weight.dtype)))
            found = scaled_dot_product_attention(asked, summary.keys, summary.values)
            found = found.transpose(1, 2).flatten(2)
        seen = torch.cat(
            (queries, found.to(queries), summary.mean.to(queries).expand_as(queries)), dim=2
        )
        return tokens + self.join(seen).transpose(0, 1).reshape(tokens.shape), summary

    def _summarise(self, embedded: Tensor) -> Summary:
        sample = self.key_norm(embedded)
        keys, values = self.keys_values(sample).to(self.queries.weight.dtype).chunk(2, dim=2)
        return Summary(_split(keys), _split(values), self.pooled(sample).mean(dim=1, keepdim=True))


def _split(tokens: Tensor) -> Tensor:
    """Split tokens (G, P, width) into heads (G, heads, P, width / heads)."""
    return tokens.view(*tokens.shape[:2], 4, -1).transpose(1, 2)


_PRIOR = 1e-4  # keeps the weighted least squares solvable if fewer than three lights have weight


class SetBranch(nn.Module):
    """A transformer over the F observations of each pixel.

    It has one token for each observation and one for the pixel. The token of an observation is
    computed from its light direction, its value, the residual of the Lambertian fit, and the
    cosines between the starting normals and its light and half vector. The tokens yield a weight
    and a corrected value for each observation, and weighted least squares gives a normal. Initially
    the weights are equal and the values are not corrected.

    With capture context, the pixel's token attends to the tokens of other pixels after each layer.
    """

    def __init__(
        self, width: int, layers: int, normals: int, *, sees_capture: bool = False
    ) -> None:
        super().__init__()
        self.observation = nn.Linear(6 + 2 * normals, width)
        self.pixel = nn.Linear(3 * normals + 1, width)
        self.layers = nn.ModuleList(AttentionLayer(width) for _ in range(layers))
        self.contexts = (
            nn.ModuleList(ContextLayer(width) for _ in range(layers)) if sees_capture else None
        )
        self.norm = nn.LayerNorm(width)
        self.weigh = zeroed(nn.Linear(width, 2))

    def forward(
        self, pixels: ScaledPixels, captures: int = 1, context: CaptureContext | None = None
    ) -> tuple[Tensor, Tensor, CaptureContext | None]:
        """Return the pixels' tokens (P, width), the unit normals (P, 3) of least squares, and the
        captures' context.

        Pixel p belongs to capture p % `captures`. Without a context, the pixels of each capture
        attend to each other.
        """
        observed, lights, residual, valid, normals, scale = pixels
        half = normalize(lights + lights.new_tensor((0.0, 0.0, 1.0)), dim=-1)
        log_observed = (observed.clamp(min=0) + 1e-3).log()  # the offset keeps the logarithm finite
        values = torch.stack((observed, log_observed, residual), dim=-1)
        features = torch.cat((lights, values, lights @ normals.mT, half @ normals.mT), dim=-1)
        count = observed.shape[1] if valid is None else valid.sum(dim=1, keepdim=True)
        log_count = torch.as_tensor(count, dtype=observed.dtype, device=observed.device).log()
        pixel = torch.cat((normals.flatten(1), log_count.expand(len(observed), 1)), dim=1)
        tokens = torch.cat((self.pixel(pixel)[:, None], self.observation(features)), dim=1)
        mask = None
        if valid is not None:
            mask = torch.cat((valid.new_ones(len(valid), 1), valid), dim=1)[:, None, None]
        if self.contexts is not None:
            brightness = (
                scale.view(-1, captures).median(dim=0).values
                if context is None
                else context.brightness
            )
            level = brightness_level(scale, brightness)
        found: list[Summary] = []
        for number, layer in enumerate(self.layers):
            tokens = layer(tokens, mask)
            if self.contexts is not None:
                known = None if context is None else context.layers[number]
                pixel, summary = self.contexts[number](tokens[:, 0], level, captures, known)
                if torch.is_grad_enabled():
                    tokens = torch.cat((pixel[:, None].to(tokens), tokens[:, 1:]), dim=1)
                else:
                    tokens[:, 0] = pixel
                found.append(summary)
        tokens = self.norm(tokens)
        with torch.autocast(observed.device.type, enabled=False):
            log_weight, correction = self.weigh(tokens[:, 1:].to(self.weigh.weight.dtype)).unbind(
                -1
            )
            weight = log_weight.clamp(-10, 10).exp()
            weight = weight if valid is None else weight * valid
            fitted = _weighted_normals(observed + correction, lights, weight)
        return tokens[:, 0], fitted, CaptureContext(brightness, tuple(found)) if found else None


class AttentionLayer(nn.Module):
    """Attention and a perceptron on tokens (P, T, width). Each is preceded by a layer norm and
    added to its input.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.heads = width // HEAD_WIDTH
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries_keys_values = nn.Linear(width, 3 * width)
        self.attended = nn.Linear(width, width)
        self.perceptron = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, tokens: Tensor, mask: Tensor | None) -> Tensor:
        pixels, count, width = tokens.shape
        split = self.queries_keys_values(self.norm1(tokens)).view(
            pixels, count, 3, self.heads, HEAD_WIDTH
        )
        if split.device.type == "cpu" and split.dtype == torch.bfloat16:
            # On a CPU, PyTorch's attention is slower in bfloat16 than in float32, its gradient up
            # to six times.
            split = split.float()
        few = mask is None and count <= _FEW_TOKENS and split.device.type == "cpu"
        with torch.autocast(tokens.device.type, enabled=False):
            if few and not torch.is_grad_enabled():
                attended = _among_few(split)
            else:
                queries, keys, values = split.permute(2, 0, 3, 1, 4)
                attended = scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
        tokens = tokens + self.attended(attended.transpose(1, 2).reshape(pixels, count, width))
        out: Tensor = tokens + self.perceptron(self.norm2(tokens))
        return out


# With more tokens, PyTorch's attention is faster on a CPU than products of small matrices
_FEW_TOKENS = 24


def _among_few(split: Tensor) -> Tensor:
    """Return the attention (P, heads, T, C) among the tokens of each pixel, from their queries,
    keys and values (P, T, 3, heads, C).
    """
    _, count, _, heads, width = split.shape
    found = split.new_empty(len(split), heads, count, width)
    for part in slices(len(split), AT_ONCE):
        queries, keys, values = split[part].permute(2, 0, 3, 1, 4).flatten(1, 2)
        weights = torch.baddbmm(
            queries.new_zeros(1, 1, 1), queries, keys.mT, beta=0, alpha=width**-0.5
        )
        weights.clamp_(-80, 80).exp_()  # their sum is finite
        total = weights.view(-1, count) @ weights.new_ones(count, 1)
        found[part] = (weights @ values).div_(total.view(-1, count, 1)).view(found[part].shape)
    return found


def _weighted_normals(targets: Tensor, lights: Tensor, weight: Tensor) -> Tensor:
    """Return the unit normals (P, 3) of weighted least squares, l . b = target."""
    weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-6)
    prior = lights.new_tensor((_PRIOR, _PRIOR, _PRIOR, 0, 0, 0))
    matrix = weighted_sum(weight, direction_products(lights)) + prior
    # If otherwise undetermined, the normal points to the camera.
    vector = weighted_sum(weight * targets, lights) + lights.new_tensor((0, 0, 1e-2 * _PRIOR))
    scaled = multiply_symmetric(inverse_3x3(matrix.unbind(-1), 1e-6), vector.unbind(-1))
    return normalize(torch.stack(scaled, dim=-1), dim=-1)
