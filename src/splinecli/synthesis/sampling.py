"""Random directions of indirect light.

One mixture is used for all materials: a cosine lobe for matte ones, and two lobes of visible GGX normals (Heitz,
"Sampling the GGX distribution of visible normals", JCGT 2018) for glossy ones. Directions are weighted by the density
of the whole mixture (the balance heuristic, Veach 1997), so materials need no sampling function of their own.
"""

import math

import torch
from torch import Tensor

LOBES = (0.0, 0.1, 0.0, 0.35)
"""Widths (roughness squared) of the lobes of four successive directions; 0 is the cosine lobe."""


def draw_directions(normals: Tensor, back: Tensor, first: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Draw directions (N, 3) and return them with their densities (N, 1). Some may be below the horizon.

    Args:
        normals: (N, 3), unit normals of the surfaces.
        back: (N, 3), unit directions to the previous vertices of the paths.
        first: (N,) int64, index of the direction among those of its pixel. It determines the lobe and the point of the
            R2 sequence (Roberts 2018), which covers the lobe evenly.
        shift: (N, 2), offset of the pixel in the sequence.
    """
    ordinal = torch.div(first, len(LOBES), rounding_mode="floor")
    u = (shift[:, 0] + ordinal * 0.7548776662466927) % 1.0
    v = (shift[:, 1] + ordinal * 0.5698402909980532) % 1.0
    tangent, bitangent = basis(normals)
    local_view = torch.stack([(back * axis).sum(-1) for axis in (tangent, bitangent, normals)], dim=1)
    lobe = first % len(LOBES)
    # Lobes of the same kind use different parts of the sequence.
    u = (u + lobe * 0.25) % 1.0
    alpha = torch.tensor(LOBES)[lobe][:, None]
    radius, angle = u.sqrt(), 2 * math.pi * v
    matte = torch.stack((radius * angle.cos(), radius * angle.sin(), (1 - u).sqrt()), dim=1)
    half = _visible_normal(local_view, alpha.clamp(min=0.01), u, v)
    mirrored = 2 * (local_view * half).sum(-1, keepdim=True) * half - local_view
    local = torch.where(alpha == 0, matte, mirrored)
    world = local[:, :1] * tangent + local[:, 1:2] * bitangent + local[:, 2:] * normals
    return world, density(local[:, 2:], local_view[:, 2:], (local * local_view).sum(-1, keepdim=True))


def density(n_dot_w: Tensor, n_dot_v: Tensor, w_dot_v: Tensor) -> Tensor:
    """Return the density of the mixture per steradian, from cosines that have the same shape."""
    half_length = (2 * (1 + w_dot_v)).clamp(min=1e-6).sqrt()
    n_dot_h = ((n_dot_w + n_dot_v) / half_length).clamp(0, 1)
    total = LOBES.count(0.0) * n_dot_w.clamp(min=0) / math.pi
    for alpha in LOBES:
        if alpha:
            squared = alpha * alpha
            spread = n_dot_h * n_dot_h * (squared - 1) + 1
            visible = 2 / (n_dot_v + (squared + (1 - squared) * n_dot_v * n_dot_v).sqrt())
            total = total + squared / (math.pi * spread * spread) * visible / 4
    return total / len(LOBES)


def basis(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors (N, 3) that form a right-handed frame with each unit normal (Duff et al. 2017)."""
    x, y, z = normals.unbind(dim=1)
    sign = torch.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), dim=1)
    return tangent, torch.stack((b, sign + y * y * a, -y), dim=1)


def _visible_normal(view: Tensor, alpha: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Return visible normals (N, 3) in the frame of the surface normal, by the routine of Heitz."""
    stretched = torch.nn.functional.normalize(
        torch.cat((alpha * view[:, :2], view[:, 2:].clamp(min=1e-4)), dim=1), dim=1
    )
    first, second = basis(stretched)
    radius, angle = u.sqrt(), 2 * math.pi * v
    across, along = radius * angle.cos(), radius * angle.sin()
    # `second` must be the axis along which the disc is cut by the horizon: the one nearer to the normal.
    upward = torch.stack((first[:, 2], second[:, 2]), dim=1)
    length = upward.norm(dim=1, keepdim=True).clamp(min=1e-6)
    cosine, sine = (upward / length).unbind(dim=1)
    level = sine[:, None] * first - cosine[:, None] * second
    steep = cosine[:, None] * first + sine[:, None] * second
    share = 0.5 * (1 + stretched[:, 2])
    along = (1 - share) * (1 - across * across).clamp(min=0).sqrt() + share * along
    depth = (1 - across * across - along * along).clamp(min=0).sqrt()
    normal = across[:, None] * level + along[:, None] * steep + depth[:, None] * stretched
    return torch.nn.functional.normalize(
        torch.cat((alpha * normal[:, :2], normal[:, 2:].clamp(min=1e-6)), dim=1), dim=1
    )
