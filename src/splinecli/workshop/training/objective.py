"""The losses of SPLINE-Net (Zheng et al., ICCV 2019, section 3), for both networks or for one while
the other is fixed.

Every loss is the mean of one number per pixel, so the loss of a batch is the mean of the losses of
its equal parts. The paper does not specify whether |.| is a sum or an average over the cells of a
map; the argument `norm` selects one.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, softplus

from splinecli.estimate.networks.li_ne_net import MORE_DEG
from splinecli.estimate.networks.spline_net import PixelMaps, Rotation, SplineNet
from splinecli.maths.observation_map import cell_directions, rotate_about_view_axis
from splinecli.workshop.synthesis.batches import DenseMap, PixelBatch
from splinecli.workshop.training.config import Norm, TrainingConfig

Part = Literal["both", "ne_net", "li_net", "error_head", "refine_net"]

# Projected length of a normal (sine of its zenith angle) below which `mirror` reduces the effect of
# its azimuth.
AXIS_LENGTH = 0.01


class Losses(NamedTuple):
    """The total loss and its unweighted terms. Each is a scalar, NaN if it was not computed."""

    total: Tensor
    angle: Tensor  # in radians
    # on_map, masked: means over cells
    on_map: Tensor
    masked: Tensor
    # symmetric, asymmetric: the sums of the LI-Net and NE-Net terms, each in its norm
    symmetric: Tensor
    asymmetric: Tensor


def part_of_step(config: TrainingConfig, step: int) -> Part:
    """Return the networks that are updated in a step."""
    if config.updates == "joint":
        return "both"
    if config.updates in ("error_head", "refine_net"):
        return config.updates
    return "li_net" if step % (config.ne_net_updates + 1) == config.ne_net_updates else "ne_net"


def compute_losses(
    network: SplineNet,
    batch: PixelBatch,
    config: TrainingConfig,
    *,
    part: Part = "both",
    turn_deg: Tensor | float = 0.0,
    mirrored: bool = False,
    bfloat16: bool = False,
) -> Losses:
    """Compute the losses of a batch (eqs. 5 and 8 of the paper; docs/train.md lists the terms).

    LI-Net: arccos(n . n_gt) + |D - D_gt| + |M_s o (D - D_gt)| + lambda_s Ls(D, n_gt) + lambda_a
    La(D, n_gt); NE-Net: arccos(n . n_gt) + lambda_s Ls(D_gt, n) + lambda_a La(D_gt, n). If both
    networks are updated, the losses are added and the angle is included only once. If pixels share
    captures, the angle is divided by the square root of the capture's error. The loss of the error
    head is the negative log-likelihood of the angle.
    """
    maps = network.build_maps(
        batch.observations, batch.light_directions, batch.valid, Rotation(turn_deg, mirrored)
    )
    normal_truth = to_pixel_frame(batch.truth.normals, maps)
    autocast = torch.autocast(
        batch.observations.device.type, dtype=torch.bfloat16, enabled=bfloat16
    )
    if part == "error_head":
        with fixed(network, part), autocast:
            normals, error = network.estimate(
                maps, network.interpolate(maps), captures=batch.captures
            )
        assert error is not None, "TrainingConfig asks for an error head"
        angle, missing = angles(normals, normal_truth), normals.new_full((), torch.nan)
        return Losses(
            error_negative_log_likelihood(error, angle).mean(), angle.mean(), *[missing] * 4
        )
    with_maps = network.config.interpolates or config.symmetric_weight or config.asymmetric_weight
    # The maps take half of the time of a batch, and CNN-PS does not use them.
    dense_truth = (
        dense_truth_in_frame(batch, maps, size=network.config.map_size) if with_maps else None
    )
    with fixed(network, part), autocast:
        with torch.set_grad_enabled(torch.is_grad_enabled() and part != "ne_net"):
            dense = network.interpolate(maps)
        normals = network.estimate(maps, dense, captures=batch.captures).normals
    of_pixels = angles(normals, normal_truth)
    angle = of_pixels.mean()
    on_map = masked = angle.new_full((), torch.nan)
    if dense is not None and dense_truth is not None:
        dense = dense.float()
        on_map = map_loss(dense, dense_truth.values, dense_truth.known)
        masked = map_loss(dense, dense_truth.values, dense_truth.known * maps.occupied)
    symmetric = asymmetric = angle.new_full((), torch.nan)
    if dense_truth is not None and (config.symmetric_weight or config.asymmetric_weight):
        symmetric, asymmetric = _special(dense, normals, dense_truth, normal_truth, config, part)
    shared = batch.captures < len(of_pixels)
    total = config.angle_weight * (
        balanced(of_pixels.view(-1, batch.captures).mean(dim=0)) if shared else angle
    )
    if part != "ne_net" and dense is not None and dense_truth is not None:
        for weight, cells in ((config.map_weight, 1), (config.masked_weight, maps.occupied)):
            known = dense_truth.known * cells
            total = total + weight * map_loss(dense, dense_truth.values, known, config.li_net_norm)
    if config.symmetric_weight:
        total = total + config.symmetric_weight * symmetric
    if config.asymmetric_weight:
        total = total + config.asymmetric_weight * asymmetric
    return Losses(total, angle, on_map, masked, symmetric, asymmetric)


def _special(
    dense: Tensor | None,
    normals: Tensor,
    dense_truth: DenseMap,
    normal_truth: Tensor,
    config: TrainingConfig,
    part: Part,
) -> tuple[Tensor, Tensor]:
    cells = cell_directions(dense_truth.values.shape[-1])[1].sum()
    terms = []
    if part != "ne_net" and dense is not None:
        terms.append((dense, normal_truth, config.li_net_norm))
    if part != "li_net":
        terms.append((dense_truth.values, normals, config.ne_net_norm))
    symmetric = asymmetric = normals.new_zeros(())
    for maps, axes, norm in terms:
        fine, coarse = asymmetries(maps, axes, dense_truth.filled)
        share = 1 / cells if norm == "mean" else 1
        symmetric = symmetric + share * fine.mean()
        asymmetric = asymmetric + share * asymmetric_loss(
            fine, coarse, eta=config.eta, lambda_c=config.lambda_c
        )
    return symmetric, asymmetric


def dense_truth_in_frame(batch: PixelBatch, maps: PixelMaps, *, size: int) -> DenseMap:
    """Return D_gt in the pixels' frames, at the scale of the sparse maps, with values clipped at
    1.
    """
    dense = batch.truth.rotate(maps.cosine, maps.sine).dense_truth(size)
    values = (dense.values * (batch.exposure / maps.scale)[..., None, None]).clamp(max=1)
    cells = values, dense.known, dense.filled
    # The cells are arranged symmetrically, so reversing the rows gives the maps of the mirrored
    # pixels.
    return DenseMap(*(each.flip(2) for each in cells) if maps.mirrored else cells)


@contextmanager
def fixed(network: SplineNet, part: Part) -> Iterator[None]:
    """Disable the gradients of parameters outside `part`. Gradients still propagate through
    them.
    """
    inside = {
        "both": ("",),
        "ne_net": ("ne_net.", "set_branch."),
        "li_net": ("li_net.",),
        "error_head": ("ne_net.error_head.",),
        "refine_net": ("refine_net.",),
    }[part]
    fixed = [
        parameter
        for name, parameter in network.named_parameters()
        if not name.startswith(inside) and parameter.requires_grad
    ]
    for parameter in fixed:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in fixed:
            parameter.requires_grad_(True)


def angles(normals: Tensor, truth: Tensor) -> Tensor:
    """Return arccos(n . n_gt) in radians, (P,); normals and truth are (P, 3), unit.

    Computed as atan2(|n x n_gt|, n . n_gt), because the gradient of arccos is infinite at an angle
    of 0.
    """
    sine = torch.linalg.cross(normals, truth).square().sum(-1).add(1e-12).sqrt()
    return torch.atan2(sine, (normals * truth).sum(-1))


def balanced(error: Tensor, reference: Tensor | None = None) -> Tensor:
    """Return the mean error of captures (G,) in radians, each divided by the square root of its
    reference.

    Therefore, an error of one degree has more weight in a capture that is already accurate. The
    reference (G,), by default `error`, indicates how difficult each capture is.
    """
    reference = error.detach() if reference is None else reference
    # Without this offset, captures that are already accurate would have too much weight.
    typical = math.radians(2.5)
    return (math.sqrt(2 * typical) * error / (reference + typical).sqrt()).mean()


def map_loss(dense: Tensor, truth: Tensor, cells: Tensor, norm: Norm = "mean") -> Tensor:
    """Return |D - D_gt| over the given cells, or |M_s o (D - D_gt)| over cells of the sparse map.

    It is averaged or summed. LI-Net's maps D and the true maps D_gt are (P, 1, w, w). `cells` is 1
    in the cells to include, whose true value must be known, and 0 elsewhere.
    """
    total = ((dense - truth).abs() * cells).sum((1, 2, 3))
    return (total if norm == "sum" else total / cells.sum((1, 2, 3)).clamp(min=1)).mean()


def mirror(maps: Tensor, normals: Tensor) -> Tensor:
    """Return r(D, n): maps (P, C, w, w), mirrored about the axis through the centre and the normal.

    The axis is given by the projections of unit normals (P, 3). The map of an isotropic pixel
    without cast shadows is its own mirror image. Values between cells are interpolated, so that the
    result has a gradient with respect to both the normal and the map. A normal towards the camera
    has no azimuth. Its map is rotated by 180 degrees, which is also a symmetry.
    """
    size = maps.shape[-1]
    centre = (torch.arange(size, device=maps.device, dtype=maps.dtype) + 0.5) * (2 / size) - 1
    y, x = torch.meshgrid(-centre, centre, indexing="ij")
    axis = normals[:, :2].to(maps.dtype)
    axis = axis / axis.square().sum(1, keepdim=True).clamp(min=AXIS_LENGTH**2).sqrt()
    axis_x, axis_y = axis[:, 0, None, None], axis[:, 1, None, None]
    along = x * axis_x + y * axis_y
    # grid_sample expects rows to run downwards, so y changes sign.
    grid = torch.stack((2 * along * axis_x - x, -(2 * along * axis_y - y)), dim=-1)
    return grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def asymmetries(dense: Tensor, normals: Tensor, filled: Tensor) -> tuple[Tensor, Tensor]:
    """Return |D - r(D, n)| and |p(D) - p(r(D, n))|, each summed over the cells of a pixel, (P,).

    The mean of the first is Ls, the loss for isotropic reflectance. p is average pooling with
    stride 2. Maps D and `filled`, 1 in cells with a value and 0 elsewhere, are (P, 1, w, w);
    normals are (P, 3), unit. Only filled cells with a filled mirror image are compared, because
    near the rim and next to gaps, a mirrored value would be partly interpolated from empty cells.
    """
    image, image_filled = torch.chunk(mirror(torch.cat((dense, filled), dim=1), normals), 2, dim=1)
    both = filled * (image_filled > 0.999)
    difference = (dense - image) * both
    fine = difference.abs().sum((1, 2, 3))
    coarse = avg_pool2d(difference, 2).abs().sum((1, 2, 3))
    return fine, coarse


def asymmetric_loss(fine: Tensor, coarse: Tensor, *, eta: float, lambda_c: float) -> Tensor:
    """Return La = ||D - r(D, n)| - eta| + lambda_c ||p(D) - p(r(D, n))| - eta|.

    Shadows and interreflections make a map slightly asymmetric, in connected regions. eta is the
    expected asymmetry, summed over cells. `fine` and `coarse` are the results of `asymmetries`.
    """
    return ((fine - eta).abs() + lambda_c * (coarse - eta).abs()).mean()


def error_negative_log_likelihood(error: Tensor, angle: Tensor) -> Tensor:
    """Return the negative log-likelihood (P,) of the logarithms of errors (P,) in radians.

    The distributions are (P, 2).
    """
    median, shape = error.unbind(-1)
    z = shape.exp() * ((angle + math.radians(MORE_DEG)).log() - median)
    return z + 2 * softplus(-z) - shape


def to_pixel_frame(vectors: Tensor, maps: PixelMaps) -> Tensor:
    """Rotate vectors (P, 3) from the capture's frame into the pixels' frames."""
    turned = rotate_about_view_axis(vectors, maps.cosine, maps.sine)
    return turned * turned.new_tensor((1.0, -1.0, 1.0)) if maps.mirrored else turned
