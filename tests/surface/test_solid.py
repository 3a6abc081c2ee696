"""Solids for printing: closed, outward, and of the volume between the surface and its back."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pytest import approx

from scenes import parametrize, pinhole, refuses
from splinecli.surface.mesh import decimated_mesh, surface_mesh
from splinecli.surface.solid import close_mesh

SHAPE = (30, 40)
WAVE = 3 * np.sin(np.arange(40) / 4) + np.arange(30)[:, None] / 5
FULL = np.ones(SHAPE, bool)
# holes, islands, and parts that touch at a corner
RAGGED = np.random.default_rng(1).uniform(size=SHAPE) < 0.75
UP = np.full((*SHAPE, 3), (0.0, 0.0, 1.0))


def check_closed(solid):
    """Every edge belongs to two triangles that pass it in opposite directions."""
    edges = np.stack((solid.triangles, np.roll(solid.triangles, -1, axis=1)), axis=2).reshape(-1, 2)
    there = set(map(tuple, edges.tolist()))
    assert len(there) == len(edges)
    assert there == {(second, first) for first, second in there}
    # Also by position, as in STL files, which have no numbers.
    assert len(np.unique(solid.vertices, axis=0)) == len(solid.vertices)


def volume(solid):
    return float(np.linalg.det(np.float64(solid.vertices[solid.triangles])).sum() / 6)


@parametrize("largest_step", [None, 2.0])
@parametrize("mask", [FULL, RAGGED], ids=["full", "ragged"])
def test_volume_over_the_triangles(mask, largest_step):
    depth = WAVE + 30 * (np.arange(40) > 25)  # a step, whose wall may be left out
    mesh = surface_mesh(depth, mask, largest_step=largest_step)
    solid = close_mesh(mesh, 2.5, perspective=False)
    check_closed(solid)
    back = solid.vertices[:, 2].min()
    heights = solid.vertices[solid.triangles, 2]
    corners = solid.vertices[solid.triangles[(heights > back).all(axis=1)]]
    assert corners[..., 2].min() - back == approx(2.5, abs=1e-5)
    # Seen along the axis, each triangle is half a pixel.
    above = corners[..., 2].mean(axis=1, dtype=np.float64) - back
    assert volume(solid) == approx(0.5 * above.sum(), rel=1e-6)
    # Few triangles touch the others at a corner only.
    assert len(corners) > 0.9 * len(mesh.triangles)


def test_a_perspective_plate():
    camera = pinhole(100, 19.5, 14.5)
    solid = close_mesh(surface_mesh(np.full(SHAPE, 50.0), FULL, camera), 5, perspective=True)
    check_closed(solid)
    # the difference of two pyramids
    assert volume(solid) == approx(39 * 29 * (55**3 - 50**3) / 3 / 100**2, rel=1e-5)
    assert_allclose(np.ptp(solid.vertices[:, :2], axis=0), 55 * np.array((39, 29)) / 100, rtol=1e-6)


def test_a_decimated_mesh():
    pytest.importorskip("fast_simplification")
    mesh = decimated_mesh(WAVE, RAGGED, n_triangles=300, normal_map=UP)
    solid = close_mesh(mesh, 1.0, perspective=False)
    check_closed(solid)
    assert volume(solid) > 0
    assert len(solid.tangents) == len(solid.vertices)


def test_a_surface_without_triangles():
    line = np.zeros(SHAPE, bool)
    line[5] = True
    with refuses("or omit --solid"):
        close_mesh(surface_mesh(WAVE, line), 1.0, perspective=False)
