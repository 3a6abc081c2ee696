"""The light of near lamps on a surface, and indirect light from other parts of the object.

Near lamps: surface points in space, and observations converted to those under distant lamps.

Indirect light is gathered from the photographs, which show how bright each visible part of the
object is under each light, including all reflections. A matte part has the same brightness from all
sides. With the surface from estimated normals, this determines the light that arrives at a pixel
from the rest of the object and is reflected there. (Nayar, Ikeuchi and Kanade, "Shape from
interreflections", IJCV 1991, also alternate between the shape and the light on it.)

Two things are unknown: the exposure, which is the observation for an albedo of 1, and whether the
object is matte enough. Attached shadows reveal both, because a pixel reflects only indirect light
if the lamp is behind its tangent plane.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from splinecli.capture.near_lamps import NearLamps
from splinecli.maths import Bools, Float32Array, Float64Array, Floats, Integers
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import Blocks, focal_length, on_map, ray_basis, rays_at
from splinecli.surface.integration import integrate_normals
from splinecli.system.machine import side_by_side


def surface_points(lamps: NearLamps, rows: Floats, columns: Floats, depth: Floats) -> Float32Array:
    """Return the points (N, 3) of a surface, in the unit of the lamps' positions.

    Rows and columns (N,) are in pixels; (0, 0) is the centre of the first pixel. The depth (N,) is
    defined as in integrate_normals: the height in pixels; with a camera matrix, the depth in
    multiples of the mean plane's depth.
    """
    if lamps.camera_matrix is None:
        middle_row, middle_column = lamps.middle
        points = np.stack((columns - middle_column, middle_row - rows, depth), axis=1)
        points = points * lamps.pixel_size
    else:
        rays = rays_at(rows, columns, lamps.camera_matrix)
        points = rays * (depth * _plane_distance(lamps))[:, None] + _camera_position(lamps)
    return points.astype(np.float32)


def flat_depth(lamps: NearLamps) -> float:
    """Return the depth of the object's mean plane; see surface_points."""
    return 0.0 if lamps.camera_matrix is None else 1.0


@dataclass(frozen=True)
class PixelLighting:
    """Observations converted to those under distant lamps, with the light directions of each
    pixel.
    """

    observations: Float32Array  # (P, F), without the attenuation with the lamps' distances
    # unit; (P, F, 3) in each pixel's own frame, whose z axis points to the camera; or (F, 3) for
    # distant lights and an orthographic camera
    directions: Floats
    # (P, 3, 3), rotations from the capture's frame to the pixels' frames; None if all are equal
    turns: Float32Array | None = None

    @classmethod
    def of(cls, observations: Float32Array, lamps: NearLamps) -> PixelLighting:
        """Return the light at the surface points of `lamps`, from observations (P, F)."""
        assert lamps.points is not None
        directions, attenuation = lamps.light_at(lamps.points)
        turns = None
        if lamps.camera_matrix is not None:
            turns = _turns_to_view(unit(_camera_position(lamps) - lamps.points)).astype(np.float32)
            directions = np.einsum("pij,pfj->pfi", turns, directions)
        return cls(observations / attenuation, directions, turns)

    @classmethod
    def distant(cls, observations: Float32Array, directions: Floats, rays: Floats) -> PixelLighting:
        """Return the light of distant lamps in directions (F, 3), for pixels with camera rays (P,
        3).
        """
        turns = _turns_to_view(unit(-rays)).astype(np.float32)
        return cls(
            observations, np.einsum("pij,fj->pfi", turns, directions.astype(np.float32)), turns
        )

    def in_frame_of_pixels(self, normals: Floats) -> Floats:
        """Return normals (P, 3), given in the capture's frame, in the frames of the pixels."""
        return normals if self.turns is None else np.einsum("pij,pj->pi", self.turns, normals)

    def in_frame_of_capture(self, vectors: Floats) -> Floats:
        """Return normals (P, 3) or directions (P, F, 3), given in the pixels' frames, in the
        capture's frame.
        """
        return vectors if self.turns is None else np.einsum("pji,p...j->p...i", self.turns, vectors)


PixelIndices = Integers  # indices of a capture's pixels, in the order of its mask
# Maps the indices of pixels to their observations and light directions.
LightingAt = Callable[[PixelIndices], PixelLighting]
# Number of pixels whose light is requested at once; under near lamps, each has its own lights
LIT_AT_ONCE = 1 << 14


def parts_of_pixels(
    count: int, size: int = LIT_AT_ONCE, *, step: int = 1
) -> Iterator[PixelIndices]:
    """Yield every step-th index below `count`, `size` at a time."""
    for start in range(0, count, step * size):
        yield np.arange(start, min(start + step * size, count), step)


def _plane_distance(lamps: NearLamps) -> float:
    """Return the distance between the camera and the mean plane, from the width of a pixel
    there.
    """
    assert lamps.camera_matrix is not None
    return focal_length(lamps.camera_matrix) * lamps.pixel_size


def _camera_position(lamps: NearLamps) -> Floats:
    """Return the camera's position (3,), from which the origin is in the middle of the image."""
    assert lamps.camera_matrix is not None
    row, column = lamps.middle
    middle = np.array((column, row, 1.0)) @ ray_basis(lamps.camera_matrix)
    return -middle * _plane_distance(lamps)


def _turns_to_view(views: Floats) -> Floats:
    """Return the shortest rotations (P, 3, 3) of unit vectors (P, 3) with z > 0 to the z axis."""
    x, y, z = views.T
    a, b, c = x * x / (1 + z), x * y / (1 + z), y * y / (1 + z)
    return np.stack((1 - a, -b, -x, -b, 1 - c, -y, x, y, z), axis=1).reshape(-1, 3, 3)


class PixelPlaces:
    """Rows and columns of the pixels of a mask, stored in two bytes per pixel for large
    captures.
    """

    def __init__(self, mask: Bools) -> None:
        kind = np.min_scalar_type(mask.shape[1])
        self._columns = np.concatenate([np.flatnonzero(row).astype(kind) for row in mask])
        self._ends = np.count_nonzero(mask, axis=1).cumsum()

    def places(self, pixels: PixelIndices) -> tuple[PixelIndices, PixelIndices]:
        """Return the rows and columns (n,) of pixels with these indices."""
        return np.searchsorted(self._ends, pixels, side="right"), self._columns[pixels]


@dataclass(frozen=True)
class IndirectLight:
    """The indirect light of a capture with P pixels."""

    blocks: Blocks  # blocks of the mask's pixels
    # (h, w, F), the light that each block receives from the others. Cells without a block copy the
    # nearest one
    arriving: Float32Array
    albedo: Floats  # (P,), the share of the arriving light that a pixel reflects
    pixels: PixelPlaces

    def at(self, pixels: PixelIndices) -> Float32Array:
        """Return the indirect part (n, F) of the observations of these pixels."""
        arriving = self.blocks.sample(self.arriving, *self.pixels.places(pixels))
        return np.asarray(arriving * self.albedo[pixels, None], np.float32)

    def remove(self, observations: Float32Array, pixels: PixelIndices) -> Float32Array:
        """Return the observations (n, F) of these pixels without their indirect part."""
        # Keep a share of each observation, because the gathered light is not exact.
        return np.asarray(
            np.maximum(observations - self.at(pixels), 0.02 * observations), np.float32
        )

    def counts_at(self, observations: Float32Array, pixels: PixelIndices) -> Bools:
        """Return whether the indirect part of pixels (n,) with observations (n, F) is
        significant.
        """
        # Less indirect light, relative to a pixel's largest observation, changes mean errors by at
        # most 0.01 degrees.
        return np.asarray(self.at(pixels).max(axis=1) > 0.02 * observations.max(axis=1))


# Pixels from which the light between parts is gathered, several hundred for each block
_GATHERED = 500_000


def find_indirect_light(
    mask: Bools,
    observations: Float32Array,
    lighting_at: LightingAt,
    normals: Float32Array,
    *,
    known: int = 1,
) -> IndirectLight | None:
    """Return the indirect light of a capture, or None if attached shadows show none that can be
    removed.

    The camera is always treated as orthographic, because only nearby parts exchange much light. The
    mask (H, W) has P true pixels. The observations (P, F) are divided only by the light
    intensities; `lighting_at` also removes the attenuation of near lamps, and returns the light
    directions. The normals (P, 3) are unit, in the capture's frame; only every `known`-th is read.
    """
    pixels = PixelPlaces(mask)
    step = known * max(1, len(normals) // (_GATHERED * known))
    # Each part begins with a pixel whose normal is known.
    parts = partial(parts_of_pixels, len(normals), LIT_AT_ONCE // known * known)
    some = partial(parts, step=step)

    def matte_albedo(rows: PixelIndices) -> Float32Array:
        light = lighting_at(rows)
        cosines = _cosines(light, normals[rows]).clip(min=0)
        shaded = np.square(cosines).sum(axis=1).clip(min=1e-6)
        return np.asarray((light.observations * cosines).sum(axis=1) / shaded, np.float32)

    def interpolated_albedo(rows: PixelIndices) -> Float32Array:
        # neighbours are shaded alike, but may differ in colour
        brightness = lighting_at(rows).observations.sum(axis=1)
        shading = matte_albedo(rows[::known]) / brightness[::known].clip(min=1e-20)
        return np.asarray(shading.repeat(known)[: len(rows)] * brightness, np.float32)

    albedo = np.concatenate([*side_by_side(matte_albedo, some())])
    total = float(albedo.sum(dtype=np.float64))
    if total <= 0:
        return None
    # This mean hardly depends on the amount of dark background.
    bright = float(albedo @ albedo) / total
    lit = albedo > 0.02 * bright  # darker ones are background
    object_mask = mask.copy()
    object_mask[mask] = lit.repeat(step)[: len(normals)]
    blocks = Blocks.over(object_mask, 1200)
    if step > 1:  # only the blocks that contain one of these pixels
        object_mask[mask] &= np.arange(len(normals)) % step == 0
        blocks = Blocks.of_step(object_mask, blocks.step)
    n_blocks = np.count_nonzero(blocks.mask)

    def sum_up(rows: PixelIndices) -> Float64Array:
        rows = rows[lit[rows // step]]
        # Limit the light that a block sends to this multiple of a matte block that faces the lamp.
        # The rest is a highlight, which is reflected in another direction.
        most = 3.0 * albedo[rows // step, None]
        sent = observations[rows] * (most / lighting_at(rows).observations.clip(min=most))
        number = blocks.numbers_at(*pixels.places(rows))
        values = np.hstack((np.ones((len(rows), 1)), normals[rows], sent))
        return np.stack([np.bincount(number, column, n_blocks) for column in values.T], axis=1)

    sums = sum(side_by_side(sum_up, some()), np.zeros(()))
    count = sums[:, :1]
    covered = step * count[:, 0] / blocks.step**2
    arriving = _exchange(blocks, covered, unit(sums[:, 1:4]), sums[:, 4:] / count)
    reflected = albedo[lit]
    indirect = IndirectLight(blocks, blocks.spread(arriving), albedo.repeat(step), pixels)
    exposure = _exposure(indirect, observations, lighting_at, normals, step)
    if exposure is None:
        return None
    # Limit this quantile of the albedo. It may exceed 1, because the gathered light is too weak if
    # the camera does not show the reflecting surface.
    exposure = min(exposure, 1.4 / float(np.quantile(reflected, 0.98)))
    if step > 1:
        albedo = np.concatenate([*side_by_side(interpolated_albedo, parts())])
    # The albedo of pixels at grazing angles to all lamps is arbitrary.
    return replace(indirect, albedo=(exposure * albedo).clip(max=10.0).astype(np.float16))


def _exchange(
    blocks: Blocks, covered: Float64Array, normals: Float64Array, sent: Float64Array
) -> Float32Array:
    """Return the light (p, F) that each block receives from the others, relative to a white block.

    Occlusion between blocks is ignored. `covered` (p,) is the share of each block that the mask
    covers, `normals` (p, 3) are unit, and `sent` (p, F) is the radiance of each block.
    """
    heights = integrate_normals(on_map(normals, blocks.mask), blocks.mask)[blocks.mask]
    rows, columns = np.nonzero(blocks.mask)
    places = np.stack((columns, -rows, heights), axis=1)
    towards = (places - places[:, None]).astype(np.float32)
    # Half the side of a block is added, because neighbours exchange light over their whole area.
    square = np.square(towards).sum(axis=-1) + 0.5**2
    facing = normals.astype(np.float32)
    leaving = -np.einsum("ijk,jk->ij", towards, facing).clip(max=0)
    entering = np.einsum("ijk,ik->ij", towards, facing).clip(min=0)
    area = (covered / normals[:, 2].clip(min=0.15)).astype(np.float32)
    # The form factor of a small part (Goral et al., "Modeling the interaction of light between
    # diffuse surfaces", 1984)
    factors = leaving * entering * area / (np.pi * np.square(square))
    factors /= factors.sum(axis=1, keepdims=True).clip(min=1)
    return np.asarray(factors @ sent.astype(np.float32))


def _exposure(
    indirect: IndirectLight,
    observations: Float32Array,
    lighting_at: LightingAt,
    normals: Float32Array,
    step: int,
) -> float | None:
    """Return the factor from albedos in the unit of the observations to true albedos, or None.

    It is None if no indirect light is visible. The factor is fitted to attached shadows, together
    with uniform ambient light. In a round bowl under a ring of lights, indirect light is just as
    uniform, and the fit attributes it to the indirect part. The albedo is known at every `step`-th
    pixel.
    """
    found = []
    step *= max(1, len(normals) // (50_000 * step))
    for pixels in parts_of_pixels(len(normals), step=step):
        light = lighting_at(pixels)
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
    # With a lower correlation between attached shadows and gathered light, the object is not matte
    # (metal, on rendered scenes).
    if not correlation >= 0.6:
        return None
    exposure = float(seen @ gathered / (gathered @ gathered))
    # Gathered and ambient light can only be separated if they are not too similar.
    if gathered @ albedo < 0.998 * np.linalg.norm(gathered) * np.linalg.norm(albedo):
        design = np.stack((gathered, albedo), axis=1)
        with_ambient, ambient = np.linalg.lstsq(design, seen, rcond=None)[0]
        exposure = float(with_ambient) if ambient > 0 else exposure
    return exposure if exposure > 0 else None


def _cosines(light: PixelLighting, normals: Float32Array) -> Float32Array:
    """Return the cosines (n, F) of the angles between normals (n, 3) and lights."""
    own, directions = light.in_frame_of_pixels(normals), light.directions.astype(np.float32)
    if directions.ndim == 2:
        return np.asarray(own @ directions.T, np.float32)
    return np.asarray(np.einsum("nk,nfk->nf", own, directions), np.float32)
