"""What lies behind an object where a mask shows more than the object, or where a capture has no mask."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from splinecli.synthesis.engraved import draw_engraved
from splinecli.synthesis.random_numbers import draw_number

_MARGIN = 16
"""Most pixels that are added at each side of the object."""

_WIDEST_RIM = 12
"""Most pixels by which a careless mask is too wide."""


def add_background(maps: Tensor, mask: Tensor, lights: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Put a background behind an object; return its maps (F + 3, h, w) and a mask (h, w) that shows some of it.

    A third of the backgrounds are nearly dark. The others are plates of draw_engraved in the shadow of the object, at
    a distance of up to half its size. Half of these are lit unevenly, as by near lamps. Half of the masks show
    everything, the others are up to 12 pixels too wide.

    Args:
        maps: (F, H, W) radiance and (3, H, W) unit normals of the object.
        mask: (H, W), of the object.
        lights: (F, 3), unit.

    Returns:
        The maps have zero for normals that are not known: in darkness, and where the light is uneven.
    """

    uniform = partial(draw_number, generator)
    sides = [int(uniform(0, _MARGIN + 1)) for _ in range(4)]
    maps, mask = pad(maps * mask, sides), pad(mask, sides)
    count, (height, width) = len(lights), mask.shape
    typical = maps[:count, mask].amax(dim=0).median()
    behind = torch.zeros_like(maps)
    if uniform() < 1 / 3:
        grain = torch.rand(count, height, width, generator=generator)
        behind[:count] = typical * 10 ** uniform(-4, -1.5) * grain
    else:
        size = max(height, width)
        normals, radiance, _ = draw_engraved(size, lights, generator, round_share=0.0)
        plate = torch.cat((radiance, normals), dim=1).T.view(-1, size, size)
        behind = plate[:, :height, :width].clone()
        behind[:count] *= typical * 10 ** uniform(-1.5, 0.3) / radiance.amax(dim=1).median().clamp(min=1e-6)
        behind[:count] *= ~_shadows(mask, lights, uniform(0, 0.5) * size)
        if uniform() < 0.5:
            rows, columns = torch.linspace(-1, 1, height)[:, None], torch.linspace(-1, 1, width)
            slope = torch.randn(3, count, 1, 1, generator=generator) / 2
            behind[:count] *= (slope[0] + slope[1] * rows + slope[2] * columns).exp()
            behind[count:] = 0
    shown = torch.ones_like(mask)
    if uniform() < 0.5:
        rim = 1 + int(uniform(0, _WIDEST_RIM))
        shown = max_pool2d(mask[None].float(), 2 * rim + 1, stride=1, padding=rim)[0] > 0
    return torch.where(mask, maps, behind), shown


def _shadows(mask: Tensor, lights: Tensor, distance: float) -> Tensor:
    """Return where (F, H, W) the object throws a shadow on a plane that lies `distance` pixels behind it."""
    reach = max(mask.shape)
    canvas = pad(mask, (reach,) * 4)
    found = []
    for x, y, z in lights.tolist():
        right, down = (max(-reach, min(reach, round(distance * side / max(z, 1e-3)))) for side in (-x, y))
        top, left = reach - down, reach - right
        found.append(canvas[top : top + mask.shape[0], left : left + mask.shape[1]])
    return torch.stack(found)
