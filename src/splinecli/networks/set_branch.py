"""The set branch: attention over a pixel's observations as they are, without rounding their lights to cells."""

import torch
from torch import Tensor, nn

from splinecli.fits.least_squares import weighted_sum
from splinecli.fits.robust import inverse_3x3, multiply_symmetric
from splinecli.networks.capture_context import CaptureContext, ContextLayer, Summary, brightness_level
from splinecli.networks.layers import zeroed

HEAD_WIDTH = 16  # channels of an attention head
DARKEST = 1e-3  # added to observations before their logarithm is taken
_PRIOR = 1e-4  # keeps the weighted least squares solvable where the weights leave fewer than three lights


class SetBranch(nn.Module):
    """A transformer over the F observations of each pixel.

    It has one token for each observation and one for the pixel. The token of an observation is made from its light
    direction, value, residual of the Lambertian fit, and the cosines between the starting normals and its light and
    half vector. The tokens give a weight and a corrected value for each observation, and least squares over these
    gives a normal. At first the weights are equal and the values are not corrected.

    If it sees the capture, the pixel's token sees those of other pixels after each layer.
    """

    def __init__(self, width: int, layers: int, normals: int, *, sees_capture: bool = False) -> None:
        super().__init__()
        self.observation = nn.Linear(6 + 2 * normals, width)
        self.pixel = nn.Linear(3 * normals + 1, width)
        self.layers = nn.ModuleList(_AttentionLayer(width) for _ in range(layers))
        self.contexts = nn.ModuleList(ContextLayer(width) for _ in range(layers)) if sees_capture else None
        self.norm = nn.LayerNorm(width)
        self.weigh = zeroed(nn.Linear(width, 2))

    def forward(
        self,
        observed: Tensor,
        lights: Tensor,
        residual: Tensor,
        valid: Tensor | None,
        normals: Tensor,
        scale: Tensor,
        *,
        captures: int = 1,
        context: CaptureContext | None = None,
    ) -> tuple[Tensor, Tensor, CaptureContext | None]:
        """Return the pixels' tokens (P, width), the unit normals (P, 3) of least squares, and the captures' context.

        The observed values and residuals (P, F) of each pixel are divided by its largest observation, `scale` (P, 1).
        The lights (P, F, 3) are unit, in the pixels' frames, `valid` (P, F) is None for all, and the starting normals
        (P, K, 3) are unit or zero. Pixel p belongs to capture p % `captures`. Without a context, the pixels of each
        capture see each other.
        """
        half = nn.functional.normalize(lights + lights.new_tensor((0.0, 0.0, 1.0)), dim=-1)
        log_observed = (observed.clamp(min=0) + DARKEST).log()
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
            brightness = scale.view(-1, captures).median(dim=0).values if context is None else context.brightness
            level = brightness_level(scale, brightness)
        found: list[Summary] = []
        for number, layer in enumerate(self.layers):
            tokens = layer(tokens, mask)
            if self.contexts is not None:
                known = None if context is None else context.layers[number]
                pixel, summary = self.contexts[number](tokens[:, 0], level, captures, known)
                tokens = torch.cat((pixel[:, None].to(tokens), tokens[:, 1:]), dim=1)
                found.append(summary)
        tokens = self.norm(tokens)
        with torch.autocast(observed.device.type, enabled=False):
            log_weight, correction = self.weigh(tokens[:, 1:].to(self.weigh.weight.dtype)).unbind(-1)
            weight = log_weight.clamp(-10, 10).exp()
            weight = weight if valid is None else weight * valid
            fitted = _weighted_normals(observed + correction, lights, weight)
        return tokens[:, 0], fitted, CaptureContext(brightness, tuple(found)) if found else None


class _AttentionLayer(nn.Module):
    """Attention and a perceptron on tokens (P, T, width). Each follows a layer norm and is added to its input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.heads = width // HEAD_WIDTH
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries_keys_values = nn.Linear(width, 3 * width)
        self.attended = nn.Linear(width, width)
        self.perceptron = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, tokens: Tensor, mask: Tensor | None) -> Tensor:
        pixels, count, width = tokens.shape
        split = self.queries_keys_values(self.norm1(tokens)).view(pixels, count, 3, self.heads, HEAD_WIDTH)
        queries, keys, values = split.permute(2, 0, 3, 1, 4)
        if queries.device.type == "cpu" and queries.dtype == torch.bfloat16:
            # PyTorch's attention on a CPU is slower in bfloat16 than in float32, and its gradient up to six times.
            queries, keys, values = queries.float(), keys.float(), values.float()
        with torch.autocast(tokens.device.type, enabled=False):
            attended = nn.functional.scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
        tokens = tokens + self.attended(attended.transpose(1, 2).reshape(pixels, count, width))
        out: Tensor = tokens + self.perceptron(self.norm2(tokens))
        return out


def _weighted_normals(targets: Tensor, lights: Tensor, weight: Tensor) -> Tensor:
    """Return the unit normals (P, 3) of weighted least squares, l . b = target."""
    weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-6)
    x, y, z = lights.unbind(-1)
    prior = lights.new_tensor((_PRIOR, _PRIOR, _PRIOR, 0, 0, 0))
    products = torch.stack((x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)
    matrix = weighted_sum(weight, products) + prior
    # Where nothing else decides, the normal points to the camera.
    vector = weighted_sum(weight * targets, lights) + lights.new_tensor((0, 0, 1e-2 * _PRIOR))
    scaled = multiply_symmetric(inverse_3x3(matrix.unbind(-1), 1e-6), vector.unbind(-1))
    return nn.functional.normalize(torch.stack(scaled, dim=-1), dim=-1)
