"""Groups of bodies and hollows: they touch, fill the frame, and have as many sharp edges as asked
for.
"""

import numpy as np
import pytest
from numpy.random import default_rng

from scenes import assert_unit
from splinecli.workshop.synthesis import groups, meshes
from splinecli.workshop.synthesis.groups import draw_body, draw_group, draw_niche
from splinecli.workshop.synthesis.meshes import REACH

pytest.importorskip("skimage")


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    """A coarser field, for speed."""
    monkeypatch.setattr(groups, "SPACING", 0.05)
    monkeypatch.setattr("splinecli.workshop.synthesis.shapes.SPACING", 0.05)
    monkeypatch.setattr(groups, "FEWEST_FACES", 500)


def ball(radius):
    mesh = meshes.triangulate(meshes.ellipsoid(np.full(3, radius, np.float32)), (1, 1, 1), 0.05)
    assert mesh is not None
    return mesh


def test_a_leaning_ball_touches_where_it_stands(rng):
    first, second = ball(0.5), ball(0.5)
    for _ in range(20):
        both = groups._leaning(first, second, rng, upward=(-0.5, 0.7), sizes=(0.4, 0.8))
        added = both.vertices[len(first.vertices) :]
        centre, radius = added.mean(axis=0), np.ptp(added, axis=0).mean() / 2
        distance = np.linalg.norm(centre)
        assert 0.2 - 0.01 < radius < 0.4 + 0.01
        # The centre is above the point by the radius, less up to a fifth of the diameter.
        assert 0.5 + 0.6 * radius - 0.01 < distance < 0.5 + radius + 0.01
        assert -0.5 - 0.1 < centre[2] / distance < 0.7 + 0.1
        np.testing.assert_array_equal(
            both.vertices[both.faces[len(first.faces) :]], added[second.faces]
        )


def test_facets_have_the_planes_they_are_drawn_from(rng):
    field = groups._draw_facets(default_rng(0), 0.5, 1.0)
    mesh = meshes.triangulate(field, (1.1, 1.1, 1.1), 0.03)
    assert mesh is not None
    # A convex body lies below the tangent plane of each of its points, those on edges apart.
    at, other = (rng.integers(len(mesh.vertices), size=4000) for _ in range(2))
    above = ((mesh.vertices[other] - mesh.vertices[at]) * mesh.vertex_normals[at]).sum(axis=1)
    assert np.quantile(above, 0.95) < 0.01


def edge_share(mesh):
    """The share of the faces whose corners' normals are more than 40 degrees apart."""
    normals = mesh.vertex_normals[mesh.faces]
    cosines = (normals * np.roll(normals, 1, axis=1)).sum(axis=2).min(axis=1)
    return float((cosines < np.cos(np.radians(40))).mean())


def test_sharper_grades_have_more_edges(monkeypatch):
    monkeypatch.setattr(groups, "SPACING", 0.025)  # otherwise, a fillet is within one face
    shares = [
        [edge_share(draw_body(default_rng([1, n]), grade)) for n in range(4)]
        for grade in (0.0, 1.0)
    ]
    assert np.mean(shares[1]) > 3 * np.mean(shares[0])


def test_a_niche_fills_the_frame_and_has_cavities():
    mesh = draw_niche(default_rng(2), 0.5)
    assert mesh is not None
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert (low[:2] < -1).all() and (high[:2] > 1).all()
    assert np.ptp(mesh.vertices[(np.abs(mesh.vertices[:, :2]) < 0.9).all(axis=1), 2]) > 0.3


def test_groups_are_of_every_kind_and_fit_the_frame():
    kinds = set()
    for n in range(12):
        kind, mesh = draw_group(default_rng([3, n]), (), n / 12)
        kinds.add(kind)
        assert mesh.vertices.dtype == mesh.vertex_normals.dtype == np.float32
        assert_unit(mesh.vertex_normals, 1e-4)
        reach = np.abs(mesh.vertices[:, :2]).max()
        assert reach > REACH - 1e-3 if kind != "bowl" else reach == pytest.approx(REACH, abs=1e-4)
    assert kinds == {"bodies", "bowl", "niche"}
