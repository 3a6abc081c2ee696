"""Ray-mesh intersection by Embree (https://www.embree.org) through embreex, and the surface visible
to a camera.

embreex is part of the extra `render` and is imported when a Tracer is created. The camera looks
along -z at the square [-1, 1]^2, orthographic or from a finite distance. A pixel is the mean of k x
k samples on a regular grid. A single sample at the centre is not enough, because on glossy metal
its radiance is wrong by a tenth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splinecli.maths.normals import unit
from splinecli.system.machine import import_extra
from splinecli.workshop.synthesis.meshes import Floats, Mesh

# Distance from the surface at which rays start. The frame has half-width 1, so float32 rounding
# displaces hits by about 1e-7; at 128 pixels, one pixel is 0.016 wide.
OFFSET = 1e-4
TRACED_ROWS = 16_384  # number of points whose shadows are traced together


@dataclass(frozen=True)
class Hits:
    """The first surface points hit by N rays."""

    triangle: NDArray[np.int64]  # (N,) int, index of the face in the mesh
    weights: Floats  # (N, 3), barycentric weights of the corners
    position: Floats  # (N, 3), on the triangle
    # normal, facet_normal: (N, 3), unit, interpolated and of the flat triangle
    normal: Floats
    facet_normal: Floats

    def take(self, rays: NDArray[np.int64] | NDArray[np.bool_]) -> Hits:
        """Return some of the points."""
        return Hits(*(getattr(self, name)[rays] for name in self.__dataclass_fields__))

    def lifted(self) -> Floats:
        """Return the origins of secondary rays (N, 3), slightly outside the surface."""
        return self.position + np.float32(OFFSET) * self.facet_normal


class Tracer:
    """A mesh prepared for ray tracing. All arrays of origins and directions are (N, 3).

    Raises UsageError if embreex is not installed.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._scene = import_extra("embreex.rtcore_scene", "render").EmbreeScene()
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float32)
        import_extra("embreex.mesh_construction", "render").TriangleMesh(self._scene, corners)
        self._facet_normals = unit(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        )

    def first_hits(self, origins: Floats, directions: Floats) -> tuple[NDArray[np.int64], Hits]:
        """Return the rows (K,) of the rays that hit the surface, and the K points that they hit
        first.
        """
        found = self._scene.run(_packed(origins), _packed(directions), output=True)
        rays = (found["primID"] >= 0).nonzero()[0]
        u, v = found["u"][rays], found["v"][rays]
        triangle, weights = (
            found["primID"][rays].astype(np.int64),
            np.stack((1 - u - v, u, v), axis=1),
        )
        corners = self.mesh.faces[triangle]
        position = np.einsum("nk,nkc->nc", weights, self.mesh.vertices[corners])
        normal = unit(np.einsum("nk,nkc->nc", weights, self.mesh.vertex_normals[corners]))
        return rays, Hits(triangle, weights, position, normal, self._facet_normals[triangle])

    def lit(
        self, origins: Floats, facing: NDArray[np.bool_], directions: Floats
    ) -> NDArray[np.bool_]:
        """Return whether rays from each origin in directions (F, 3) miss the mesh: (N, F), false if
        not `facing`.

        With a single light (F = 1), the directions may also differ between origins: (N, 3).
        """
        free = np.zeros(facing.shape, dtype=bool)
        own = facing.shape[1] == 1 and len(directions) == len(origins)
        # Trace one light at a time: parallel rays need less memory and traverse the tree together.
        for light, asked in enumerate(facing.T):
            rows = asked.nonzero()[0]
            if len(rows):
                blocked = self._scene.run(
                    _packed(origins[rows]),
                    _packed(directions[rows] if own else directions[light : light + 1]),
                    query="OCCLUDED",
                )
                free[rows, light] = blocked < 0
        return free


class ShadowCache:
    """The lights that reach each vertex of the mesh, traced when they are first needed."""

    def __init__(self, tracer: Tracer, lights: Floats) -> None:
        self._tracer, self._lights = tracer, lights
        vertices = len(tracer.mesh.vertices)
        # Unused rows take no memory.
        self._free = np.zeros((vertices, len(lights)), dtype=bool)
        self._known = np.zeros(vertices, dtype=bool)

    def lit(self, hits: Hits) -> NDArray[np.bool_]:
        """Return which lights reach the vertices nearest to the surface points, (N, F).

        It is faster to pass many points at a time.
        """
        mesh = self._tracer.mesh
        nearest = np.asarray(mesh.faces[hits.triangle, hits.weights.argmax(axis=1)], dtype=np.int64)
        new = np.unique(nearest[~self._known[nearest]])
        for start in range(0, len(new), TRACED_ROWS):
            some = new[start : start + TRACED_ROWS]
            normals = mesh.vertex_normals[some]
            origins = mesh.vertices[some] + np.float32(OFFSET) * normals
            self._free[some] = self._tracer.lit(origins, normals @ self._lights.T > 0, self._lights)
        self._known[new] = True
        return self._free[nearest]


def _packed(vectors: Floats) -> Floats:
    return np.ascontiguousarray(vectors, dtype=np.float32)


@dataclass(frozen=True)
class VisibleSurface:
    """The surface points visible to the camera in P pixels, with S samples each."""

    mask: NDArray[np.bool_]  # (H, W), the visible pixels
    normals: Floats  # (P, 3), unit, the mean of the samples' normals; pixels row-major
    samples: Hits  # P * S surface points, grouped by pixel
    samples_per_pixel: int  # S
    coverage: Floats  # (P,), share of the pixel that the surface fills; below 1 at its outline
    # (P * S, 3), unit, towards the camera; None for (0, 0, 1), an orthographic camera
    back: Floats | None = None

    def samples_of(self, pixels: NDArray[np.int64]) -> Hits:
        """Return all samples of some pixels."""
        count = self.samples_per_pixel
        return self.samples.take((pixels[:, None] * count + np.arange(count)).ravel())


def find_visible_surface(
    tracer: Tracer,
    size: int,
    samples: int,
    bend: Callable[[Floats, Floats], Floats] | None = None,
    *,
    distance: float = np.inf,
) -> VisibleSurface:
    """Trace the camera's rays: size x size pixels of samples x samples samples each.

    At a finite `distance`, the camera is at (0, 0, distance), and the square [-1, 1]^2 is in the
    plane z = 0.

    A pixel is dropped if more than half of its samples miss the surface, or if the surface is at a
    grazing angle. Samples that miss are replaced by other samples of the same pixel. `bend` gives
    new normals (N, 3) from the mesh normals and the positions of the samples.
    """
    steps = (np.arange(size * samples, dtype=np.float32) + 0.5) * np.float32(
        2 / (size * samples)
    ) - 1
    row, column = np.meshgrid(np.arange(size * samples), np.arange(size * samples), indexing="ij")

    def by_pixel(grid: NDArray[np.int64]) -> NDArray[np.int64]:
        return grid.reshape(size, samples, size, samples).transpose(0, 2, 1, 3).ravel()

    x, y = steps[by_pixel(column)], -steps[by_pixel(row)]
    if orthographic := np.isinf(distance):
        top = np.full_like(x, tracer.mesh.vertices[:, 2].max() + 1)
        rays, hits = tracer.first_hits(
            np.stack((x, y, top), axis=1), np.array([[0, 0, -1]], dtype=np.float32)
        )
    else:
        camera = np.array((0, 0, distance), dtype=np.float32)
        towards = unit(np.stack((x, y, np.zeros_like(x)), axis=1) - camera)
        rays, hits = tracer.first_hits(np.tile(camera, (len(x), 1)), towards)

    def facing(normals: Floats, positions: Floats) -> Floats:
        """Return the cosines (N,) of the normals with the directions to the camera."""
        return np.asarray(
            normals[:, 2] if orthographic else (normals * unit(camera - positions)).sum(axis=1)
        )

    front = facing(hits.normal, hits.position) > 0
    rays, hits = rays[front], hits.take(front)
    if bend is not None:
        hits = replace(hits, normal=bend(hits.normal, hits.position))
    per_pixel = samples * samples
    found = np.bincount(rays // per_pixel, minlength=size * size)
    seen = 2 * found > per_pixel
    first = np.cumsum(found) - found  # row of the first sample of each pixel
    rows = first[seen, None] + np.arange(per_pixel) % found[seen, None]
    normals = unit(hits.normal[rows].mean(axis=1))
    # Drop pixels at a more grazing angle.
    kept = facing(normals, hits.position[rows[:, 0]]) > 0.05
    coverage = (found[seen] / per_pixel).astype(np.float32)
    seen[seen] = kept
    mask = seen.reshape(size, size)
    shown = hits.take(rows[kept].ravel())
    back = None if orthographic else unit(camera - shown.position)
    return VisibleSurface(mask, normals[kept], shown, per_pixel, coverage[kept], back)
