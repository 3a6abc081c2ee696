"""The refinement net, which corrects maps of normals and their errors, and the layout of its input
features.

The features are computed in refinement/features.py.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from types import EllipsisType

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d, pad

from splinecli.estimate.networks.li_ne_net import ResidualBlock, zeroed

FEATURE_WIDTHS = {
    "normal": 3,  # the estimated normal
    "robust": 3,  # the normal of the robust Lambertian fit, minus the estimated normal
    "plain": 3,  # the least-squares normal, minus the estimated normal
    # mean light direction, weighted by the residuals of a matte surface with this normal
    "unexplained_light": 2,
    "mean_light": 2,
    "light_moments": 3,  # xx, yy and xy of the light directions
    "error_median": 1,  # median of the error distribution; see networks/li_ne_net.py
    "error_shape": 1,
    "largest": 1,  # logarithm of the largest observation, relative to the capture
    "mean": 1,  # of the observations, divided by the largest; likewise the next two
    "deviation": 1,
    "residual": 1,  # root mean square
    "dark_share": 1,  # share of dark observations
    "n_lights": 1,  # logarithm
    # difference between two halves of the lights; the sign is arbitrary. See TwoHalves
    "halves": 3,
    # of least squares; not read by the net, but used by restore_detail in refinement/detail.py
    "noise": 1,
}
"""The features and their numbers of channels. The first two channels of a vector are x and y."""


def channels(name: str) -> slice:
    """Return the slice of a feature's channels."""
    names = list(FEATURE_WIDTHS)
    start = sum(FEATURE_WIDTHS[other] for other in names[: names.index(name)])
    return slice(start, start + FEATURE_WIDTHS[name])


FEATURE_CHANNELS = sum(FEATURE_WIDTHS.values())
READ = channels("noise").start  # number of channels read by the net
# Channels with the x and y components of vectors, which rotate with the image.
VECTORS = tuple(
    (channels(name).start, channels(name).start + 1)
    for name in ("normal", "robust", "plain", "unexplained_light", "mean_light", "halves")
)

_FIRST = channels("light_moments").start
TENSOR = (_FIRST, _FIRST + 1, _FIRST + 2)  # channels with the xx, yy and xy components of a tensor
_ERROR = slice(channels("error_median").start, channels("error_shape").stop)
MEDIAN_OFFSET = 3.0  # shifts the logarithm of typical errors in radians close to zero


def split_features(features: Tensor) -> tuple[Tensor, Tensor]:
    """Return normals (B, 3, H, W) and error (B, 2, H, W) from maps of features (B,
    FEATURE_CHANNELS, H, W).
    """
    return features[:, channels("normal")], features[:, _ERROR] + _error_offset(features)


def _error_offset(features: Tensor) -> Tensor:
    return features.new_tensor((-MEDIAN_OFFSET, 1.0))[:, None, None]


def with_refined(features: Tensor, normals: Tensor, error: Tensor) -> Tensor:
    """Return maps of features (B, FEATURE_CHANNELS, H, W) with other normals (B, 3, H, W) and
    errors (B, 2, H, W).

    The features that describe how well the estimated normal explains the observations are not
    updated.
    """
    turned = features[:, channels("normal")] - normals
    changed = features.clone()
    changed[:, channels("normal")] = normals
    for other in ("robust", "plain"):
        changed[:, channels(other)] += turned
    changed[:, _ERROR] = error - _error_offset(features)
    return changed


WIDTHS = (32, 64, 96, 64)  # channels at full, half, quarter and eighth resolution
# Widths in pixels of smoothed normals, which the net weights against the estimated normal
SIGMAS = (0.7, 1.5, 3.0)
# Side of a pixel at the coarsest scale. Tile origins are multiples of COARSEST.
COARSEST = 2 ** (len(WIDTHS) - 1)
Box = tuple[slice, slice]  # rows and columns of a map


class RefineNet(nn.Module):
    """An encoder-decoder of four scales with residual blocks, no normalisation, and the identity as
    initial state.

    The result is the estimated normal, plus weighted differences between smoothed normals and the
    estimate, plus a correction.

    After each layer, everything outside the mask is set to zero. Pixels outside the mask are
    therefore equivalent to pixels outside the image, so tiles with an overlap of `reach` give the
    same result as the whole image.

    `twice` adds a second such net, `again`, which corrects the result. It reads the same features
    as the first, with the normals and errors replaced by the first net's results. `reach` is the
    distance in pixels beyond which other pixels do not affect a result.
    """

    def __init__(self, *, twice: bool = False) -> None:
        super().__init__()
        self.enter = nn.Conv2d(READ + 1 + 3 * len(SIGMAS), WIDTHS[0], 3, padding=1)
        self.down = nn.ModuleList(
            nn.Conv2d(fine, coarse, 2, stride=2) for fine, coarse in pairwise(WIDTHS)
        )
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairwise(WIDTHS))
        self.encode = nn.ModuleList(
            nn.ModuleList(ResidualBlock(width) for _ in range(count))
            for width, count in zip(WIDTHS, (1, 2, 3, 2), strict=True)  # in the encoder
        )
        self.decode = nn.ModuleList(
            nn.ModuleList(ResidualBlock(width) for _ in range(count))
            for width, count in zip(WIDTHS, (1, 1, 0), strict=False)  # in the decoder
        )
        self.out = zeroed(nn.Conv2d(WIDTHS[0], 5 + len(SIGMAS), 3, padding=1))
        self.again = RefineNet() if twice else None
        self.reach = 96 * (1 + twice)  # 96 per net

    def forward(
        self, features: Tensor, mask: Tensor, inner: Box | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return unit normals (B, 3, h, w) and errors (B, 2, h, w), zero outside a mask (B, 1, H,
        W) of 1 and 0.

        The features (B, FEATURE_CHANNELS, H, W) of refine_features are zero outside the mask, too.
        `inner` is the requested part of the map, whose bounds are multiples of COARSEST or the end
        of the map; None for all. The decoder skips the rest.
        """
        if self.again is not None:
            features = with_refined(features, *self._correct(features, mask, None)) * mask
            found: tuple[Tensor, Tensor] = self.again(features, mask, inner)
            return found
        return self._correct(features, mask, inner)

    def _correct(self, features: Tensor, mask: Tensor, inner: Box | None) -> tuple[Tensor, Tensor]:
        height, width = mask.shape[-2:]
        rows, columns = (slice(None), slice(None)) if inner is None else inner
        inner = slice(*rows.indices(height)[:2]), slice(*columns.indices(width)[:2])
        border = (0, -width % COARSEST, 0, -height % COARSEST)
        # The data type of the layers. In training, the sums over the blocks stay in float32.
        device = features.device.type
        layers = features.dtype
        if torch.is_autocast_enabled(device):
            layers = torch.get_autocast_dtype(device)
        stream = features.dtype if torch.is_grad_enabled() else layers
        masks = [pad(mask, border).to(layers)]
        for _ in self.down:
            masks.append(max_pool2d(masks[-1], 2))
        normals, error = (part.contiguous() for part in split_features(features))
        # Weight normals by their certainty, the inverse of the median error, whose logarithm is
        # given.
        weight = (-error[:, :1].clamp(-6.0, 1.0)).exp() * mask
        smoothed = (unit_maps(gaussian_sum(normals * weight, sigma)) * mask for sigma in SIGMAS)
        towards = [smooth - normals for smooth in smoothed]
        # In place if possible, because a tile's maps of 32 channels determine the memory required.
        read = features[:, :READ], *towards, mask
        x = self.enter(_joined(read, border, layers)).mul_(masks[0]).to(stream)
        mask, normals, error, *towards = (
            maps[..., *inner].contiguous() for maps in (mask, normals, error, *towards)
        )
        passed = []
        for scale, blocks in enumerate(self.encode):
            if scale:
                passed.append(x)
                x = self.down[scale - 1](x).mul_(masks[scale]).to(stream)
            for block in blocks:  # type: ignore[attr-defined]
                x = block(x, masks[scale])
        origin = (0, 0)
        for scale in reversed(range(len(passed))):
            # The minimum margin, in pixels of each scale, that the decoder needs around a part of
            # the map
            wanted = _grown(inner, 4 << scale)
            within = masks[scale][_cells(wanted, (0, 0), scale)]
            x = self.up[scale](x[_cells(wanted, origin, scale + 1)])
            x = interpolate(x, scale_factor=2, mode="nearest").mul_(within)
            x = passed.pop()[_cells(wanted, (0, 0), scale)] + x
            origin = wanted[0].start, wanted[1].start
            for block in self.decode[scale]:  # type: ignore[attr-defined]
                x = block(x, within)
        change = self.out(torch.relu(x))[_cells(inner, origin, 0)].to(normals.dtype).contiguous()
        corrected = normals + change[:, :3]
        for weight, difference in zip(change[:, 5:].split(1, dim=1), towards, strict=True):
            corrected = corrected + weight * difference
        return unit_maps(corrected) * mask, (error + change[:, 3:5]) * mask


def _joined(maps: Sequence[Tensor], border: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Concatenate maps along the channels, with a border of zeros, in the layout that is fastest
    for the layers.
    """
    batch, _, height, width = maps[0].shape
    size = batch, sum(part.shape[1] for part in maps), height + border[3], width + border[1]
    joined = torch.empty(
        size, dtype=dtype, device=maps[0].device, memory_format=torch.channels_last
    )
    if any(border):
        joined.zero_()
    start = 0
    for part in maps:
        joined[:, start : start + part.shape[1], :height, :width] = part
        start += part.shape[1]
    return joined


def _grown(part: Box, margin: int) -> Box:
    """Return a part with a margin, expanded to whole pixels of the coarsest scale. It may extend
    past the map.
    """
    rows, columns = (
        slice(max(0, side.start - margin), side.stop + -side.stop % COARSEST + margin)
        for side in part
    )
    return rows, columns


def _cells(part: Box, origin: tuple[int, int], scale: int) -> tuple[EllipsisType, slice, slice]:
    """Return the index of a part in a map of the given scale that begins at the pixel `origin`."""
    rows, columns = (
        slice(side.start - start >> scale, side.stop - start >> scale)
        for side, start in zip(part, origin, strict=True)
    )
    return ..., rows, columns


def unit_maps(vectors: Tensor) -> Tensor:
    """Scale vectors (..., 3, H, W) to unit length, faster than with a norm over the channels. Zero
    stays zero.
    """
    x, y, z = torch.split(vectors, 1, dim=-3)
    length = (x * x + y * y + z * z).clamp(min=1e-24).sqrt()
    return vectors / length


def reach_of(sigma: float) -> int:
    """Return the radius in pixels of a filter of this width."""
    return math.ceil(3 * sigma)


def gaussian_sum(maps: Tensor, sigma: float) -> Tensor:
    """Return sums of maps (..., H, W) with Gaussian weights, of which the largest is 1. Maps are
    padded with zeros.
    """
    reach = reach_of(sigma)
    kernel = [math.exp(-0.5 * (place / sigma) ** 2) for place in range(-reach, reach + 1)]
    return _filtered(_filtered(maps, kernel, -1), kernel, -2)


def _filtered(maps: Tensor, kernel: Sequence[float], axis: int) -> Tensor:
    # Faster than a convolution for so few channels.
    reach, size = len(kernel) // 2, maps.shape[axis]
    padded = pad(maps, (reach, reach) if axis == -1 else (0, 0, reach, reach))
    found = kernel[0] * padded.narrow(axis, 0, size)
    for start, weight in enumerate(kernel[1:], 1):
        found.add_(padded.narrow(axis, start, size), alpha=weight)
    return found
