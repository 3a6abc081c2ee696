"""SPLINE-Net (Zheng et al., ICCV 2019): from observations to maps, through LI-Net and NE-Net, to
normals.

The differences of the compact size are described in docs/method.md. Its dense map has the scale of
the sparse map, the largest observation. Values above 1 are clipped, so that a highlight under
another light does not change the scale of all other values.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from splinecli.estimate.fits.least_squares import fit_lambertian
from splinecli.estimate.networks.config import NetworkConfig, fit_normals
from splinecli.estimate.networks.li_ne_net import CompactLINet, CompactNENet, PaperLINet, PaperNENet
from splinecli.estimate.networks.refine_net import RefineNet
from splinecli.estimate.networks.set_branch import (
    CaptureContext,
    PixelTokens,
    ScaledPixels,
    SetBranch,
)
from splinecli.maths.observation_map import (
    cell_directions,
    map_scale,
    rotate_about_view_axis,
    sparse_map,
    unit_disc,
)


class Rotation(NamedTuple):
    """A rotation of the lights about the view axis, and a reflection."""

    turn_deg: float | Tensor = 0.0  # angle in degrees, a number or (P,)
    # whether y is flipped after the rotation. An isotropic pixel looks the same if its lights are
    # mirrored, too.
    mirror: bool = False


NO_ROTATION = Rotation()


class PixelMaps(NamedTuple):
    """Observation maps of P pixels with the associated fits and lights,
    in each pixel's own frame.
    """

    # sparse, occupied, residual, lambertian_map: (P, 1, w, w); occupied is 1 in cells with an
    # observation
    sparse: Tensor
    occupied: Tensor
    residual: Tensor
    lambertian_map: Tensor
    lambertian_normals: Tensor  # (P, 3), unit
    scale: Tensor  # (P, 1), the largest observation, which is 1 in the maps
    fitted_normals: Tensor  # (P, K, 3), from the additional fits in the configuration
    # cosine, sine: (P,), of the rotation from the capture's frame to the pixel's
    cosine: Tensor
    sine: Tensor
    mirrored: bool  # whether y is flipped after the rotation
    # observed, residuals: (P, F), the scaled observations and their residuals
    observed: Tensor
    residuals: Tensor
    lights: Tensor  # (P, F, 3), in the pixels' frames
    valid: Tensor | None  # (P, F) bool, or None for all


class Estimate(NamedTuple):
    """Unit normals (P, 3), and the distributions of their errors (P, 2), None without an error
    head.
    """

    normals: Tensor
    error: Tensor | None


class SplineNet(nn.Module):
    """LI-Net, NE-Net and all steps from raw observations to normals; the refinement nets then run
    on the normal map.
    """

    cells: Tensor
    inside: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.li_net: nn.Module | None = None
        self.ne_net: nn.Module
        if config.size == "paper":
            self.li_net = PaperLINet() if config.interpolates else None
            self.ne_net = PaperNENet(1 + config.interpolates, config.map_size)
        else:
            self.li_net = CompactLINet(config) if config.interpolates else None
            self.ne_net = CompactNENet(config)
        self.set_branch: SetBranch | None = None
        if config.set_width:
            fits = 1 + len(config.fits)
            self.set_branch = SetBranch(
                config.set_width, config.set_layers, fits, sees_capture=config.sees_capture
            )
        self.refine_net: RefineNet | None = None
        if config.refines:
            self.refine_net = RefineNet(twice=config.refines_twice)
        cells, _ = cell_directions(config.map_size)
        inside = unit_disc(config.map_size, config.grid)
        self.register_buffer("cells", cells.view(-1, 3), persistent=False)
        self.register_buffer("inside", inside.float()[None, None], persistent=False)

    def build_maps(
        self,
        observations: Tensor,
        light_directions: Tensor,
        valid: Tensor | None = None,
        rotation: Rotation = NO_ROTATION,
    ) -> PixelMaps:
        """Build the maps of observations (P, F) under light_directions (F, 3) or (P, F, 3), in the
        pixels' frames.

        Observations that are not valid (P, F) are ignored. The given rotation is applied after the
        rotation to the canonical azimuth.
        """
        scale = map_scale(observations, valid)
        observed = observations / scale
        if self.config.is_canonical:
            scaled_normals = fit_lambertian(observed, light_directions, valid)
        else:
            scaled_normals = observed.new_tensor((0.0, 0.0, 1.0)).expand(len(observed), 3)
        x, y, z = scaled_normals.unbind(-1)
        # Move a fit that points away from the camera to the rim, which has the closest visible
        # normal. Unlike hypot, this norm has a finite gradient at zero.
        z = torch.maximum(z, 0.02 * scaled_normals[:, :2].norm(dim=-1))
        azimuth = torch.atan2(y, x) if self.config.is_canonical else torch.zeros_like(x)
        turn_deg = torch.as_tensor(rotation.turn_deg, device=azimuth.device)
        angle = turn_deg * (math.pi / 180) - azimuth
        cosine, sine = angle.cos(), angle.sin()
        lights = rotate_about_view_axis(
            light_directions.expand(*observed.shape, 3), cosine[:, None], sine[:, None]
        )
        scaled_normals = rotate_about_view_axis(torch.stack((x, y, z), dim=-1), cosine, sine)
        fitted = fit_normals(self.config.fits, observed, light_directions, valid)
        fitted = rotate_about_view_axis(fitted, cosine[:, None], sine[:, None])
        if rotation.mirror:
            flip = lights.new_tensor((1.0, -1.0, 1.0))
            lights, scaled_normals, fitted = lights * flip, scaled_normals * flip, fitted * flip
        albedo = scaled_normals.norm(dim=-1, keepdim=True).clamp(min=1e-3)
        predicted = (lights @ scaled_normals[..., None])[..., 0]
        residual = ((observed - predicted) / albedo).clamp(-3.0, 3.0)
        side, grid = self.config.map_size, self.config.grid
        stacked = torch.stack((observed, residual), dim=-1)
        maps = sparse_map(stacked, lights, valid, size=side, grid=grid)
        lambertian_map = (scaled_normals @ self.cells.T).clamp(0, 1).view(-1, 1, side, side)
        return PixelMaps(
            maps.values[:, :1],
            maps.occupied,
            maps.values[:, 1:],
            lambertian_map,
            scaled_normals / scaled_normals.norm(dim=-1, keepdim=True).clamp(min=1e-12),
            scale,
            fitted,
            cosine,
            sine,
            rotation.mirror,
            observed,
            residual,
            lights,
            valid,
        )

    def interpolate(self, maps: PixelMaps) -> Tensor | None:
        """Return the dense maps of LI-Net (P, 1, w, w), zero outside the unit disc; None without a
        LI-Net.
        """
        if self.li_net is None:
            return None
        if self.config.size == "paper":
            dense: Tensor = self.li_net(maps.sparse)
        else:
            dense = maps.lambertian_map + self.li_net(torch.cat(maps[:4], dim=1))
        return dense * self.inside

    def estimate(
        self,
        maps: PixelMaps,
        dense: Tensor | None,
        *,
        captures: int = 1,
        context: CaptureContext | None = None,
    ) -> Estimate:
        """Return the normals of NE-Net in the pixels' frames, and their errors.

        Pixel p belongs to capture p % `captures`. The context comes from `encode_context`; without
        one, the pixels of each capture attend to each other, if the network has layers for capture
        context.
        """
        interpolated = [] if dense is None else [dense.to(maps.sparse.dtype)]
        if self.config.size == "paper":
            raw, error = self.ne_net(torch.cat((maps.sparse, *interpolated), dim=1)), None
        else:
            normals, features = _starting_normals(maps), None
            if self.set_branch is not None:
                features, fitted, _ = self._read_set(maps, normals, captures, context)
                normals = torch.cat((normals, fitted[:, None]), dim=1)
            channels = torch.cat((*maps[:4], *interpolated), dim=1)
            raw, error = self.ne_net(channels, normals, features)
        return Estimate(normalize(raw.float(), dim=-1), error)

    def forward(
        self,
        observations: Tensor,
        light_directions: Tensor,
        valid: Tensor | None = None,
        rotation: Rotation = NO_ROTATION,
        context: CaptureContext | None = None,
    ) -> Estimate:
        """Return normals in the capture's frame, and their errors.

        The observations (P, F) are linear, divided by the light intensities, of any scale. The
        light directions are unit, (F, 3) or (P, F, 3); x right, y up, z to the camera. The context
        comes from `encode_context`; without one, all pixels attend to each other, if the network
        has layers for capture context. See build_maps for the other arguments.
        """
        # Only the convolutions may run in bfloat16: the fits and the geometry of the maps need full
        # precision.
        with torch.autocast(observations.device.type, enabled=False):
            maps = self.build_maps(observations, light_directions, valid, rotation)
        normals, error = self.estimate(maps, self.interpolate(maps), context=context)
        return Estimate(to_capture_frame(normals, maps), error)

    def encode_context(
        self, observations: Tensor, light_directions: Tensor, rotation: Rotation = NO_ROTATION
    ) -> CaptureContext | None:
        """Return the context of a capture from a sample of its pixels; None if the network does not
        use context.

        The observations (P, F), the light directions and the rotation are as in `forward`. About
        SAMPLE pixels are enough.
        """
        if self.set_branch is None or not self.config.sees_capture:
            return None
        return self.encode_pixels(observations, light_directions, rotation=rotation)[1]

    def encode_pixels(
        self,
        observations: Tensor,
        light_directions: Tensor,
        valid: Tensor | None = None,
        rotation: Rotation = NO_ROTATION,
        *,
        captures: int = 1,
        context: CaptureContext | None = None,
    ) -> tuple[PixelTokens, CaptureContext | None]:
        """Return the tokens of the set branch for pixels, and the context of their captures.

        The arguments are as in `forward` and `estimate`. Only for networks with a set branch.
        """
        with torch.autocast(observations.device.type, enabled=False):
            maps = self.build_maps(observations, light_directions, valid, rotation)
        tokens, fitted, found = self._read_set(maps, _starting_normals(maps), captures, context)
        count = torch.full_like(maps.scale, observations.shape[1])
        if valid is not None:
            count = valid.sum(1, keepdim=True).to(count)
        return PixelTokens(tokens.float(), fitted[:, 2:], maps.scale, count), found

    def _read_set(
        self, maps: PixelMaps, normals: Tensor, captures: int, context: CaptureContext | None
    ) -> tuple[Tensor, Tensor, CaptureContext | None]:
        assert self.set_branch is not None
        pixels = ScaledPixels(
            maps.observed, maps.lights, maps.residuals, maps.valid, normals, maps.scale
        )
        return self.set_branch(pixels, captures, context)  # type: ignore[no-any-return]


def _starting_normals(maps: PixelMaps) -> Tensor:
    return torch.cat((maps.lambertian_normals[:, None], maps.fitted_normals), dim=1)


def to_capture_frame(normals: Tensor, maps: PixelMaps) -> Tensor:
    """Rotate normals (P, 3) from the pixels' frames back into the capture's frame."""
    if maps.mirrored:
        normals = normals * normals.new_tensor((1.0, -1.0, 1.0))
    return rotate_about_view_axis(normals, maps.cosine, -maps.sine)
