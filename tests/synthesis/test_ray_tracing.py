"""Rays against surfaces whose intersections are known."""

from typing import Any

import numpy as np
import pytest

from splinecli.synthesis.meshes import Mesh
from splinecli.synthesis.ray_tracing import OFFSET, Tracer

pytest.importorskip("embreex", reason="needs the extra 'render'")
trimesh: Any = pytest.importorskip("trimesh", reason="needs the extra 'render'")


def ball(radius: float = 0.8) -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    vertices = solid.vertices.astype(np.float32)
    return Mesh(vertices, solid.faces.astype(np.int32), vertices / np.float32(radius))


def unit(count: int, seed: int) -> Any:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def test_first_hits_lie_where_the_line_meets_the_ball() -> None:
    rng = np.random.default_rng(0)
    origins = np.column_stack((rng.uniform(-1, 1, (2000, 2)), np.full(2000, 3))).astype(np.float32)
    down = np.array([[0, 0, -1]], np.float32)
    rays, hits = Tracer(ball()).first_hits(origins, down)
    radius = np.hypot(*origins[:, :2].T)
    # A ball of 20 480 facets is up to 0.0004 smaller than the true one.
    assert set((radius < 0.799).nonzero()[0]) <= set(rays)
    assert (radius[rays] < 0.8).all()
    x, y = origins[rays, 0], origins[rays, 1]
    expected = np.column_stack((x, y, np.sqrt(0.64 - x * x - y * y)))
    inner = radius[rays] < 0.7
    np.testing.assert_allclose(hits.position[inner], expected[inner], atol=1e-3)
    np.testing.assert_allclose(hits.normal[inner], expected[inner] / 0.8, atol=1e-3)
    assert (hits.normal * hits.facet_normal).sum(axis=1).min() > 0.999
    np.testing.assert_allclose(hits.weights.sum(axis=1), 1, atol=1e-5)
    lifted = ((hits.lifted() - hits.position) * hits.facet_normal).sum(axis=1)
    np.testing.assert_allclose(lifted, OFFSET, rtol=0.01)


def test_the_nearest_of_several_surfaces_is_hit() -> None:
    inner, outer = ball(0.3), ball(0.8)
    both = Mesh(
        np.concatenate((inner.vertices, outer.vertices)),
        np.concatenate((inner.faces, outer.faces + len(inner.vertices))).astype(np.int32),
        np.concatenate((inner.vertex_normals, outer.vertex_normals)),
    )
    directions = unit(500, 1)
    _, outward = Tracer(both).first_hits(np.zeros((500, 3), np.float32), directions)
    np.testing.assert_allclose(np.linalg.norm(outward.position, axis=1), 0.3, atol=1e-3)
    _, inward = Tracer(both).first_hits(2 * directions, -directions)
    np.testing.assert_allclose(np.linalg.norm(inward.position, axis=1), 0.8, atol=1e-3)


def test_a_convex_body_shades_what_faces_away_and_nothing_else() -> None:
    tracer, points, lights = Tracer(ball()), unit(400, 2), unit(7, 3)
    _, hits = tracer.first_hits(2 * points, -points)
    cosines = hits.facet_normal @ lights.T
    everything = np.ones(cosines.shape, dtype=bool)
    lit = tracer.lit(hits.lifted(), everything, lights)
    # Rays that graze the facet they start above, near its edge, may pass over the next one: 2 degrees off.
    clear = np.abs(cosines) > 0.1
    np.testing.assert_array_equal(lit[clear], (cosines > 0)[clear])
    # Where it is not asked, the answer is no.
    assert not tracer.lit(hits.lifted(), ~everything, lights).any()
