"""Random light rigs: the number of lights per pixel and their directions."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from splinecli.workshop.synthesis import draw_uniform


def draw_light_counts(
    pixels: int,
    low: int,
    high: int,
    usual: int,
    generator: torch.Generator,
    *,
    usual_share: float = 0.5,
) -> Tensor:
    """Draw the number of lights of each pixel (P,). Within a draw, they differ by at most a fifth.

    Each draw has a maximum: for `usual_share` of the draws it is usual - 1 to usual + 2, otherwise
    it is log-uniform over low..high. Every pixel has at least four fifths of that number, so that
    there is little padding.
    """
    anywhere = low * ((high + 1) / low) ** draw_uniform(generator, 1)
    about = usual - 1 + 4 * draw_uniform(generator, 1)
    largest = (
        torch.where(draw_uniform(generator, 1) < usual_share, about, anywhere)
        .floor()
        .clamp(low, high)
    )
    return (largest * (1 - 0.2 * draw_uniform(generator, pixels))).round().long().clamp(low, high)


def choose_in_cone(directions: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` random indices of the light directions (F, 3) within a cone about the view
    axis.

    The half-angle of the cone is U(20, 90) degrees, as in CNN-PS (Ikehata, ECCV 2018). If it
    contains too few lights, the closest others are added.
    """
    return rank_in_cone(directions[None], generator)[0].argsort()[:count]


def rank_in_cone(directions: Tensor, generator: torch.Generator) -> Tensor:
    """Return ranks (P, F) of the lights (P, F, 3) of P pixels, of which the lowest are chosen.

    See choose_in_cone.
    """
    uniform = draw_uniform(generator, *directions.shape[:2])
    half_angle = _uniform_deg(generator, len(directions), 1, low=20, high=90)
    z = directions[..., 2]
    # Lights within the cone have a random rank below 1. The others follow, the closest to the axis
    # first.
    return torch.where(z >= half_angle.cos(), uniform, 2 - z)


Points = tuple[Tensor, Tensor]  # x and y (P, F) of lights in the disc of their projections
RIG_SHARES = {"ellipse": 0.68, "cone": 0.08, "ring": 0.08, "line": 0.08, "hand-held": 0.08}
"""Shares of the kinds of rigs."""


def draw_light_directions(
    pixels: int, lights: int, generator: torch.Generator, shares: Mapping[str, float] = RIG_SHARES
) -> Tensor:
    """Draw unit light directions (P, F, 3), a rig for each pixel.

    A rig is a set of points in the (x, y) disc. It is rotated about the view axis at random, and
    points beyond a radius of 0.996 are moved to the rim of the disc.
    """
    kind = torch.multinomial(
        torch.tensor([shares.get(name, 0.0) for name in _RIGS], device=generator.device),
        pixels,
        replacement=True,
        generator=generator,
    )
    x = torch.zeros(pixels, lights, device=generator.device)
    y = torch.zeros_like(x)
    for number, draw_rig in enumerate(_RIGS.values()):
        rows = (kind == number).nonzero()[:, 0]
        if len(rows):
            x[rows], y[rows] = draw_rig(len(rows), lights, generator)
    x, y = _turn(x, y, 2 * math.pi * draw_uniform(generator, pixels, 1))
    shrink = (0.996 / torch.hypot(x, y).clamp(min=1e-6)).clamp(max=1)
    x, y = x * shrink, y * shrink
    return torch.stack((x, y, (1 - x * x - y * y).clamp(min=0).sqrt()), dim=-1)


def _draw_ellipse(pixels: int, lights: int, generator: torch.Generator) -> Points:
    """Fill an ellipse uniformly, by projected area.

    One half-axis is sin U(20, 88) degrees, and the other is U(0.5, 1) times as long. Half of the
    rigs are off-centre by up to 0.35 (1 - 0.6 half-axis), as on a copy stand, a shelf, or with a
    lamp above.
    """
    x, y = _in_disc(pixels, lights, generator)
    major = _uniform_deg(generator, pixels, 1, low=20, high=88).sin()
    x, y = x * major, y * major * draw_uniform(generator, pixels, 1, low=0.5)
    x, y = _turn(x, y, 2 * math.pi * draw_uniform(generator, pixels, 1))
    leans = draw_uniform(generator, pixels, 1) < 0.5
    return x + leans * draw_uniform(generator, pixels, 1, high=0.35) * (1 - 0.6 * major), y


def _draw_cone(pixels: int, lights: int, generator: torch.Generator) -> Points:
    """Fill a disc of radius sin U(8, 20) degrees. Its centre is at up to 0.5 from the view axis."""
    x, y = _in_disc(pixels, lights, generator)
    radius = _uniform_deg(generator, pixels, 1, low=8, high=20).sin()
    return x * radius + draw_uniform(generator, pixels, 1, high=0.5), y * radius


def _draw_ring(pixels: int, lights: int, generator: torch.Generator) -> Points:
    """Place lights evenly at one angle of U(15, 75) degrees from the view axis, within 2 degrees
    (sigma).

    Half of the rings are complete, the others are arcs of U(120, 360) degrees. The azimuths have a
    sigma of 10 degrees.
    """
    arc = _uniform_deg(generator, pixels, 1, low=120, high=360)
    arc = torch.where(draw_uniform(generator, pixels, 1) < 0.5, 2 * math.pi, arc)
    azimuth = arc * torch.arange(lights, device=generator.device) / lights
    polar = _uniform_deg(generator, pixels, 1, low=15, high=75)
    return _near(polar, azimuth, lights, generator, polar_sigma_deg=2, azimuth_sigma_deg=10)


def _draw_line(pixels: int, lights: int, generator: torch.Generator) -> Points:
    """Place lights on a line of half-length sin U(30, 85) degrees, at up to 0.5 from the view axis.

    They deviate from the line with a sigma of sin U(1, 10) degrees, so they are nearly coplanar.
    """
    x = (
        draw_uniform(generator, pixels, lights, low=-1)
        * _uniform_deg(generator, pixels, 1, low=30, high=85).sin()
    )
    sigma = _uniform_deg(generator, pixels, 1, low=1, high=10).sin()
    return x, draw_uniform(generator, pixels, 1, high=0.5) + sigma * _normal(
        generator, pixels, lights
    )


def _draw_hand_held(pixels: int, lights: int, generator: torch.Generator) -> Points:
    """Place lights in clusters, 20 to 70 degrees from the view axis, in a sector of U(90, 360)
    degrees.

    A cluster has U(1, 5) lights on average. They spread with a sigma of 6 degrees in either angle.
    """
    clusters = (lights / draw_uniform(generator, pixels, 1, low=1, high=5)).clamp(min=1)
    member = torch.arange(lights, device=generator.device).remainder(clusters).long()
    sector = _uniform_deg(generator, pixels, 1, low=90, high=360)
    azimuth = (draw_uniform(generator, pixels, lights) * sector).gather(1, member)
    polar = _uniform_deg(generator, pixels, lights, low=20, high=70).gather(1, member)
    return _near(polar, azimuth, lights, generator, polar_sigma_deg=6, azimuth_sigma_deg=6)


_RIGS = {
    "ellipse": _draw_ellipse,
    "cone": _draw_cone,
    "ring": _draw_ring,
    "line": _draw_line,
    "hand-held": _draw_hand_held,
}


def _in_disc(pixels: int, lights: int, generator: torch.Generator) -> Points:
    radius = draw_uniform(generator, pixels, lights).sqrt()
    angle = 2 * math.pi * draw_uniform(generator, pixels, lights)
    return radius * angle.cos(), radius * angle.sin()


def _near(
    polar: Tensor,
    azimuth: Tensor,
    lights: int,
    generator: torch.Generator,
    *,
    polar_sigma_deg: float,
    azimuth_sigma_deg: float,
) -> Points:
    """Return points near the given angles from and about the view axis (P, F) or (P, 1)."""
    shape = len(polar), lights
    polar = polar + math.radians(polar_sigma_deg) * _normal(generator, *shape)
    azimuth = azimuth + math.radians(azimuth_sigma_deg) * _normal(generator, *shape)
    # Beyond the horizon, the sine would move a light back into the disc.
    radius = polar.clamp(max=math.pi / 2).sin()
    return radius * azimuth.cos(), radius * azimuth.sin()


def _turn(x: Tensor, y: Tensor, angle: Tensor) -> Points:
    return angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y


def _uniform_deg(generator: torch.Generator, *shape: int, low: float, high: float) -> Tensor:
    """Draw angles in radians, uniform between two angles in degrees."""
    return torch.deg2rad(draw_uniform(generator, *shape, low=low, high=high))


def _normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, device=generator.device)
