"""Light that reaches a pixel from other parts of the object, gathered from the photographs themselves.

The photographs show how bright each visible part of the object is under each light, after all reflections. A matte part
is as bright from all sides. Estimated normals give the surface. Together they give the light that arrives at a pixel
from the rest of the object, and the pixel reflects it. (Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV
1991, also alternate between the shape and the light on it.)

Two things are unknown: the exposure, that is the observation for an albedo of 1, and whether the object is matte
enough. Attached shadows show both, because a pixel reflects only indirect light if the lamp is behind its tangent
plane.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from splinecli.lights.lamp_light import LampLight, LightOf, Rows, parts_of_rows
from splinecli.maths import Bools, Doubles, Floats, Singles
from splinecli.maths.normals import unit
from splinecli.surface.integration import integrate_normals
from splinecli.surface.pixel_grid import Blocks
from splinecli.system.machine import side_by_side

_BLOCKS = 1200  # parts of the surface that exchange light


_DARK_SHARE = 0.02  # of the bright pixels' albedo; darker ones are background
_LEAST_Z = 0.15  # of a block's normal, for its area


class PixelPlaces:
    """Rows and columns of the pixels of a mask. Two bytes a pixel, as captures may have many."""

    def __init__(self, mask: Bools) -> None:
        kind = np.min_scalar_type(mask.shape[1])
        self._columns = np.concatenate([np.flatnonzero(row).astype(kind) for row in mask])
        self._ends = np.count_nonzero(mask, axis=1).cumsum()

    def places(self, pixels: Rows) -> tuple[Rows, Rows]:
        """Return the rows and columns (n,) in the image of pixels with these numbers."""
        return np.searchsorted(self._ends, pixels, side="right"), self._columns[pixels]


@dataclass(frozen=True)
class IndirectLight:
    """The indirect light of a capture with P pixels."""

    blocks: Blocks  # of the mask's pixels
    arriving: Singles  # (h, w, F), the light at each block from the others. Other cells copy the nearest block
    albedo: Floats  # (P,), the share of the arriving light that a pixel reflects
    pixels: PixelPlaces

    def at(self, pixels: Rows) -> Singles:
        """Return the indirect part (n, F) of the observations of some of the capture's pixels."""
        arriving = self.blocks.sample(self.arriving, *self.pixels.places(pixels))
        return np.asarray(arriving * self.albedo[pixels, None], np.float32)

    def remove(self, observations: Singles, pixels: Rows) -> Singles:
        """Return the observations (n, F) of some of the capture's pixels without their indirect part."""
        # Keep a share of each observation, because the gathered light is never exact.
        return np.asarray(np.maximum(observations - self.at(pixels), 0.02 * observations), np.float32)

    def counts_at(self, observations: Singles, pixels: Rows) -> Bools:
        """Return for which of some pixels (n,) with observations (n, F) the indirect part is not negligible."""
        # Indirect light up to this share of a pixel's largest observation changes mean errors by 0.01 degrees at
        # most.
        return np.asarray(self.at(pixels).max(axis=1) > 0.02 * observations.max(axis=1))


def find_indirect_light(
    mask: Bools, observations: Singles, light_of: LightOf, normals: Singles
) -> IndirectLight | None:
    """Return the indirect light of a capture, or None if the attached shadows show none that could be removed.

    The camera is always treated as orthographic, because only nearby parts exchange much light.

    Args:
        mask: (H, W), with P true pixels.
        observations: (P, F), as they were photographed, divided by the intensities alone.
        light_of: gives the observations of some pixels without the falloff of near lamps, and the light directions.
        normals: (P, 3) unit, in the capture's frame.
    """
    pixels = PixelPlaces(mask)
    parts = partial(parts_of_rows, len(normals))
    albedo = np.concatenate([*side_by_side(lambda rows: _albedo(light_of(rows), normals[rows]), parts())])
    total = float(albedo.sum(dtype=np.float64))
    if total <= 0:
        return None
    # A mean that hardly depends on how much dark background there is.
    bright = float(albedo @ albedo) / total
    lit = albedo > _DARK_SHARE * bright
    object_mask = mask.copy()
    object_mask[mask] = lit
    blocks = Blocks.over(object_mask, _BLOCKS)
    n_blocks = np.count_nonzero(blocks.mask)

    def sum_up(rows: Rows) -> Doubles:
        rows = rows[lit[rows]]
        # A block sends at most this many times the light of a matte one that faces the lamp. The rest is a
        # highlight, which goes in another direction.
        most = 3.0 * albedo[rows, None]
        sent = observations[rows] * (most / light_of(rows).observations.clip(min=most))
        number = blocks.numbers_at(*pixels.places(rows))
        values = np.hstack((np.ones((len(rows), 1)), normals[rows], sent))
        return np.stack([np.bincount(number, column, n_blocks) for column in values.T], axis=1)

    sums = sum(side_by_side(sum_up, parts()), np.zeros(()))
    count = sums[:, :1]
    covered = count[:, 0] / blocks.step**2
    arriving = _exchange(blocks, covered, unit(sums[:, 1:4]), sums[:, 4:] / count)
    indirect = IndirectLight(blocks, blocks.spread(arriving), albedo, pixels)
    exposure = _exposure(indirect, observations, light_of, normals)
    if exposure is None:
        return None
    # This quantile of the albedos is at most so large. It may exceed 1, because the gathered light is too weak
    # if the reflecting surface is hidden from the camera.
    exposure = min(exposure, 1.4 / float(np.quantile(albedo[lit], 0.98)))
    # Pixels that all lamps graze may have any albedo.
    return replace(indirect, albedo=(exposure * albedo).clip(max=10.0).astype(np.float16))


def _exchange(blocks: Blocks, covered: Doubles, normals: Doubles, sent: Doubles) -> Singles:
    """Return the light (p, F) that arrives at each block from the others, relative to the light a white one reflects.

    Occlusion between blocks is ignored. `covered` (p,) is the share of each block that the mask covers, `normals`
    (p, 3) are unit, and `sent` (p, F) is the radiance of each block.
    """
    normal_map = np.zeros((*blocks.mask.shape, 3))
    normal_map[blocks.mask] = normals
    heights = integrate_normals(normal_map, blocks.mask)[blocks.mask]
    rows, columns = np.nonzero(blocks.mask)
    places = np.stack((columns, -rows, heights), axis=1)
    towards = (places - places[:, None]).astype(np.float32)
    # Add half the side of a block, because neighbours exchange light over their whole area, not only their centres.
    square = np.square(towards).sum(axis=-1) + 0.5**2
    facing = normals.astype(np.float32)
    leaving = -np.einsum("ijk,jk->ij", towards, facing).clip(max=0)
    entering = np.einsum("ijk,ik->ij", towards, facing).clip(min=0)
    area = (covered / normals[:, 2].clip(min=_LEAST_Z)).astype(np.float32)
    # The form factor of a small part (Goral et al., "Modeling the interaction of light between diffuse surfaces", 1984)
    factors = leaving * entering * area / (np.pi * np.square(square))
    factors /= factors.sum(axis=1, keepdims=True).clip(min=1)
    return np.asarray(factors @ sent.astype(np.float32))


def _exposure(indirect: IndirectLight, observations: Singles, light_of: LightOf, normals: Singles) -> float | None:
    """Return the factor from albedos in the observations' unit to true ones; None without visible indirect light.

    It is fitted to the attached shadows, together with ambient light that arrives everywhere alike. In a round bowl
    under a ring of lights, indirect light is just as uniform, and the fit assigns it to the indirect part.
    """
    found = []
    step = max(1, len(normals) // 50_000)
    for pixels in parts_of_rows(len(normals), step=step):
        light = light_of(pixels)
        gathered = indirect.at(pixels)
        # In attached shadows, the cosine of the angle between light and normal is negative.
        shadow = (_cosines(light, normals[pixels]) < -0.05) & (gathered > 0)
        albedo = np.broadcast_to(indirect.albedo[pixels, None], shadow.shape)
        found.append(np.stack((observations[pixels][shadow], gathered[shadow], albedo[shadow])))
    seen, gathered, albedo = np.hstack(found).astype(np.float64)
    if len(seen) < 50:
        return None
    with np.errstate(invalid="ignore"):  # black shadows have no correlation
        correlation = np.corrcoef(seen, gathered)[0, 1]
    # Correlation of attached shadows and gathered light. Below it, the object is not matte: on rendered scenes,
    # metal.
    if not correlation >= 0.6:
        return None
    exposure = float(seen @ gathered / (gathered @ gathered))
    # If gathered and ambient light are more alike, they cannot be separated.
    if gathered @ albedo < 0.998 * np.linalg.norm(gathered) * np.linalg.norm(albedo):
        with_ambient, ambient = np.linalg.lstsq(np.stack((gathered, albedo), axis=1), seen, rcond=None)[0]
        exposure = float(with_ambient) if ambient > 0 else exposure
    return exposure if exposure > 0 else None


def _albedo(light: LampLight, normals: Singles) -> Singles:
    """Return the albedos (n,) of matte pixels, in the unit of the observations."""
    cosines = _cosines(light, normals).clip(min=0)
    shaded = np.square(cosines).sum(axis=1).clip(min=1e-6)
    return np.asarray((light.observations * cosines).sum(axis=1) / shaded, np.float32)


def _cosines(light: LampLight, normals: Singles) -> Singles:
    """Return the cosines (n, F) of the angles between normals (n, 3) and lights."""
    own, directions = light.in_frame_of_pixels(normals), light.directions.astype(np.float32)
    if directions.ndim == 2:
        return np.asarray(own @ directions.T, np.float32)
    return np.asarray(np.einsum("nk,nfk->nf", own, directions), np.float32)
