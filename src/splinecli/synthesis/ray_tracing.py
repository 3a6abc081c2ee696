"""Intersection of rays with a mesh, by Embree (https://www.embree.org) through embreex.

embreex belongs to the extra `render`. It is imported when a Tracer is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.synthesis.meshes import Floats, Mesh
from splinecli.system.extras import import_extra

OFFSET = 1e-4
"""Distance from the surface at which rays start. The frame has half-width 1, so rounding in float32 displaces hits by
about 1e-7, and one of 128 pixels is 0.016 wide."""

TRACED_ROWS = 16_384  # number of points whose shadows are traced together


@dataclass(frozen=True)
class Hits:
    """The first surface points that N rays hit.

    triangle: (N,) int, row of the mesh's faces.
    weights: (N, 3), barycentric weights of the corners.
    position: (N, 3), on the triangle.
    normal, facet_normal: (N, 3), unit, interpolated and that of the triangle.
    """

    triangle: NDArray[np.int64]
    weights: Floats
    position: Floats
    normal: Floats
    facet_normal: Floats

    def take(self, rays: NDArray[np.int64] | NDArray[np.bool_]) -> Hits:
        """Return some of the points."""
        return Hits(*(getattr(self, name)[rays] for name in self.__dataclass_fields__))

    def lifted(self) -> Floats:
        """Return the starts of further rays (N, 3), slightly outside the surface."""
        return self.position + np.float32(OFFSET) * self.facet_normal


class Tracer:
    """A mesh that is prepared for ray tracing. All arrays of origins and directions are (N, 3).

    Raises UsageError if embreex is not installed.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._scene = import_extra("embreex.rtcore_scene", "render").EmbreeScene()
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float32)
        import_extra("embreex.mesh_construction", "render").TriangleMesh(self._scene, corners)
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(facing, axis=1, keepdims=True)
        self._facet_normals = (facing / np.maximum(length, 1e-30)).astype(np.float32)

    def first_hits(self, origins: Floats, directions: Floats) -> tuple[NDArray[np.int64], Hits]:
        """Return the rows (K,) of the rays that hit the surface, and the K points that they hit first."""
        found = self._scene.run(_packed(origins), _packed(directions), output=True)
        rays = (found["primID"] >= 0).nonzero()[0]
        u, v = found["u"][rays], found["v"][rays]
        return rays, self.points(found["primID"][rays].astype(np.int64), np.stack((1 - u - v, u, v), axis=1))

    def points(self, triangle: NDArray[np.int64], weights: Floats) -> Hits:
        """Return the surface points with these barycentric weights (N, 3) on these triangles (N,)."""
        corners = self.mesh.faces[triangle]
        position = np.einsum("nk,nkc->nc", weights, self.mesh.vertices[corners])
        normal = np.einsum("nk,nkc->nc", weights, self.mesh.vertex_normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return Hits(triangle, weights, position, normal, self._facet_normals[triangle])

    def lit(self, origins: Floats, facing: NDArray[np.bool_], directions: Floats) -> NDArray[np.bool_]:
        """Return whether rays from each origin in directions (F, 3) miss the mesh: (N, F), false if not `facing`.

        With one light, F = 1, the directions may also be those of each origin, (N, 3).
        """
        free = np.zeros(facing.shape, dtype=bool)
        own = facing.shape[1] == 1 and len(directions) == len(origins)
        # One light at a time: rays with the same direction need less memory and traverse the tree together.
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
        # Rows that are never used take no memory.
        self._free = np.zeros((vertices, len(lights)), dtype=bool)
        self._known = np.zeros(vertices, dtype=bool)

    def lit(self, hits: Hits) -> NDArray[np.bool_]:
        """Return which lights reach the vertices nearest to the surface points, (N, F) bool."""
        nearest = self._nearest(hits)
        self._trace(nearest)
        return self._free[nearest]

    def prepare(self, hits: Hits) -> None:
        """Trace the shadows at surface points in advance: many together are faster than few at a time."""
        self._trace(self._nearest(hits))

    def _nearest(self, hits: Hits) -> NDArray[np.int64]:
        faces = self._tracer.mesh.faces
        return np.asarray(faces[hits.triangle, hits.weights.argmax(axis=1)], dtype=np.int64)

    def _trace(self, vertices: NDArray[np.int64]) -> None:
        new = np.unique(vertices[~self._known[vertices]])
        mesh = self._tracer.mesh
        for start in range(0, len(new), TRACED_ROWS):
            some = new[start : start + TRACED_ROWS]
            normals = mesh.vertex_normals[some]
            origins = mesh.vertices[some] + np.float32(OFFSET) * normals
            self._free[some] = self._tracer.lit(origins, normals @ self._lights.T > 0, self._lights)
        self._known[new] = True


def _packed(vectors: Floats) -> Floats:
    return np.ascontiguousarray(vectors, dtype=np.float32)
