"""Groups of bodies and hollows: they fill the frame, and have as many sharp edges as asked for."""

import numpy as np
import pytest
from numpy.random import default_rng

from scenes import assert_unit
from splinecli.workshop.synthesis import groups
from splinecli.workshop.synthesis.groups import draw_body, draw_group, draw_niche
from splinecli.workshop.synthesis.meshes import REACH

pytest.importorskip("skimage")


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    """A coarser field, for speed."""
    monkeypatch.setattr(groups, "SPACING", 0.05)
    monkeypatch.setattr("splinecli.workshop.synthesis.shapes.SPACING", 0.05)
    monkeypatch.setattr(groups, "FEWEST_FACES", 500)


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
