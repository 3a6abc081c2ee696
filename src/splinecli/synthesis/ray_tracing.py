"""Rays against a mesh, traced by Embree (https://www.embree.org) through embreex.

embreex, scikit-image and trimesh are the extra `render`: nothing but rendering needs them, so they are imported
when a scene is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.extras import import_extra
from splinecli.synthesis.meshes import Floats, Mesh

# Rays start this far above the surface, in the camera's frame of half-width 1: float32 leaves hits uncertain by
# 1e-7 or so, and a pixel of 128 is 0.016 wide.
OFFSET = 1e-4
# Points whose shadows are traced together.
TRACED_ROWS = 16_384


@dataclass(frozen=True)
class Hits:
    """The first surface points that N rays meet.

    triangle (N,) int: row of the mesh's faces; weights (N, 3): barycentric, of the triangle's corners;
    position (N, 3): on the triangle; normal and facet_normal (N, 3): unit, interpolated and the triangle's own.
    """

    triangle: NDArray[np.int64]
    weights: Floats
    position: Floats
    normal: Floats
    facet_normal: Floats

    def take(self, rays: NDArray[np.int64] | NDArray[np.bool_]) -> Hits:
        """Some of the points."""
        return Hits(*(getattr(self, name)[rays] for name in self.__dataclass_fields__))

    def lifted(self) -> Floats:
        """Starts of further rays (N, 3), off the surface on its outer side."""
        return self.position + np.float32(OFFSET) * self.facet_normal


class Tracer:
    """A mesh made ready for rays. All arrays of origins and directions are (N, 3).

    Raises:
        UsageError: embreex is not installed.
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
        """The rays that meet the surface, as rows of the input (K,), and where (K points)."""
        found = self._scene.run(_packed(origins), _packed(directions), output=True)
        rays = (found["primID"] >= 0).nonzero()[0]
        u, v = found["u"][rays], found["v"][rays]
        return rays, self.points(found["primID"][rays].astype(np.int64), np.stack((1 - u - v, u, v), axis=1))

    def points(self, triangle: NDArray[np.int64], weights: Floats) -> Hits:
        """The surface points with these barycentric weights (N, 3) on these triangles (N,)."""
        corners = self.mesh.faces[triangle]
        position = np.einsum("nk,nkc->nc", weights, self.mesh.vertices[corners])
        normal = np.einsum("nk,nkc->nc", weights, self.mesh.vertex_normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return Hits(triangle, weights, position, normal, self._facet_normals[triangle])

    def lit(self, origins: Floats, facing: NDArray[np.bool_], directions: Floats) -> NDArray[np.bool_]:
        """Which directions (F, 3) are free of the mesh from which origins, where `facing` (N, F) asks: (N, F)."""
        free = np.zeros(facing.shape, dtype=bool)
        # Light by light, since rays of one direction are one array shorter and traverse the tree together.
        for light, asked in enumerate(facing.T):
            rows = asked.nonzero()[0]
            if len(rows):
                blocked = self._scene.run(
                    _packed(origins[rows]), _packed(directions[light : light + 1]), query="OCCLUDED"
                )
                free[rows, light] = blocked < 0
        return free


class ShadowCache:
    """Which lights reach which vertices of the mesh, traced when first asked for."""

    def __init__(self, tracer: Tracer, lights: Floats) -> None:
        self._tracer, self._lights = tracer, lights
        vertices = len(tracer.mesh.vertices)
        # Rows that are never asked for take no memory.
        self._free = np.zeros((vertices, len(lights)), dtype=bool)
        self._known = np.zeros(vertices, dtype=bool)

    def lit(self, hits: Hits) -> NDArray[np.bool_]:
        """Which lights are free of the mesh at the vertices nearest to surface points, (N, F) bool."""
        nearest = self._nearest(hits)
        self._trace(nearest)
        return self._free[nearest]

    def expect(self, hits: Hits) -> None:
        """Trace for surface points that will be asked for: many together are quicker than few at a time."""
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
