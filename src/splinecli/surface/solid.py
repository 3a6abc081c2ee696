"""Closed meshes for printing: a surface with walls along its border and a flat back."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.maths import Indices
from splinecli.surface.mesh import SurfaceMesh, no_triangles


def close_mesh(mesh: SurfaceMesh, thickness: float, *, perspective: bool) -> SurfaceMesh:
    """Return the solid between a surface and a plane behind it, perpendicular to the viewing axis.

    The walls follow the viewing rays of the border, so they are parallel to the axis for an
    orthographic camera, and diverge from the camera for a perspective one. Every edge of the solid
    belongs to exactly two triangles, and the normals of the triangles point outwards. Where two
    parts of the surface touch only at a vertex, triangles of one part are left out, because an edge
    of the walls would belong to four triangles.

    Args:
        mesh: an open surface with triangles counter-clockwise in the camera's view.
        thickness: the distance from the lowest vertex to the plane, positive.
        perspective: whether the camera is at the origin, instead of at infinity.

    Raises:
        InputError: the surface has no triangles.
    """
    triangles = _manifold(mesh.triangles)
    if not len(triangles):
        raise no_triangles(instead="omit --solid")
    used, numbers = np.unique(triangles, return_inverse=True)
    triangles = numbers.reshape(-1, 3).astype(np.int32)
    front = mesh.vertices[used]
    plane = front[:, 2].min() - np.float32(thickness)
    back = front * (plane / front[:, 2:]) if perspective else front.copy()
    back[:, 2] = plane
    first, second = _edges(triangles)[_opposite(triangles) < 0].T  # of the border
    behind, n_front = triangles + len(used), len(used)
    walls = ((second, first, first + n_front), (second, first + n_front, second + n_front))
    closed = np.concatenate((triangles, behind[:, ::-1], *(np.stack(w, axis=1) for w in walls)))
    normals = mesh.normals[used]
    away = np.broadcast_to(np.array((0, 0, -1), np.float32), normals.shape)

    def twice(values: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate((values[used], values[used]))

    return replace(
        mesh,
        vertices=np.concatenate((front, back)),
        triangles=closed.astype(np.int32),
        normals=np.concatenate((normals, away)),
        uvs=twice(mesh.uvs),
        tangents=None if mesh.tangents is None else twice(mesh.tangents),
    )


def _edges(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the directed edges (3 T, 2) of triangles (T, 3)."""
    return np.stack((triangles, np.roll(triangles, -1, axis=1)), axis=2).reshape(-1, 2)


def _keys(edges: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return one integer for each directed edge (E, 2)."""
    return np.asarray(edges @ np.array((1 << 32, 1)), np.int64)


def _opposite(triangles: NDArray[np.int32]) -> Indices:
    """Return the index of each directed edge's reverse (3 T,), or -1 without one."""
    edges = _edges(triangles)
    keys, wanted = _keys(edges), _keys(edges[:, ::-1])
    order = np.argsort(keys)
    found = order[np.searchsorted(keys, wanted, sorter=order).clip(max=len(order) - 1)]
    return np.where(keys[found] == wanted, found, -1)


def _manifold(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the triangles without those that touch the others only at a vertex.

    The triangles around each vertex then form a single fan, whose border is closed or contains the
    vertex once. If several triangles have an edge in the same direction, which decimation may
    cause, the first is kept.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    while len(triangles):
        # Corner i is the start of edge i. Both triangles at an edge have a corner at each end.
        corners, opposite = np.arange(triangles.size), _opposite(triangles)
        inside = opposite >= 0
        following = corners - corners % 3 + (corners + 1) % 3
        links = (corners[inside], following[opposite[inside]])
        graph = coo_array((np.ones(len(links[0])), links), shape=(triangles.size,) * 2)
        fan = connected_components(graph, directed=False)[1]
        largest = np.zeros(int(triangles.max()) + 1, np.intp)
        by_size = np.argsort(np.bincount(fan)[fan], kind="stable")
        largest[triangles.ravel()[by_size]] = fan[by_size]  # the last assignment counts
        kept = fan == largest[triangles.ravel()]
        kept &= np.isin(corners, np.unique(_keys(_edges(triangles)), return_index=True)[1])
        kept = kept.reshape(-1, 3).all(axis=1)
        if kept.all():
            break
        triangles = triangles[kept]
    return triangles
