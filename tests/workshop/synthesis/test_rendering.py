"""Light transport against closed forms: a sphere, a wall's shadow, the inside of a bowl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from pytest import approx
from torch import Tensor

from scenes import on_sphere, parametrize, vectors

pytest.importorskip("embreex")

from numpy.testing import assert_allclose

from distributions import seeded
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.workshop.synthesis import scenes as rendering
from splinecli.workshop.synthesis.meshes import Mesh
from splinecli.workshop.synthesis.ray_tracing import Tracer, find_visible_surface
from splinecli.workshop.synthesis.scenes import render_direct, render_indirect


@dataclass(frozen=True)
class Matte:
    """Lambert's law, exactly."""

    reflectance: Tensor

    def take(self, pixels):
        return Matte(self.reflectance[pixels])

    def shade(self, n_dot_l, n_dot_v, l_dot_v):
        return self.reflectance * n_dot_l.clamp(min=0)

    def albedo(self):
        return self.reflectance


@pytest.fixture(autouse=True)
def _no_lobes(monkeypatch):
    """A matte surface has no sharp lobes that the renderer would soften."""
    soften = rendering.soften

    def soften_others(found, lowest):
        return found if isinstance(found, Matte) else soften(found, lowest)

    monkeypatch.setattr(rendering, "soften", soften_others)


def matte(reflectance):
    return {"matte": Matte(torch.full((1, 1), reflectance))}


def ball(radius, *, polar, inward, rings=120, sectors=240):
    """The part of a sphere within `polar` degrees of its pole: +z seen from outside, or -z seen
    from inside.
    """
    theta = np.linspace(1e-4, np.radians(polar), rings)
    phi = np.linspace(0, 2 * np.pi, sectors, endpoint=False)
    t, p = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    sign = -1 if inward else 1
    unit = np.stack((np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), sign * np.cos(t)), axis=1)
    row, column = (
        grid.ravel()
        for grid in np.meshgrid(np.arange(rings - 1), np.arange(sectors), indexing="ij")
    )
    a, b = row * sectors + column, row * sectors + (column + 1) % sectors
    c, d = a + sectors, b + sectors
    # Anticlockwise from outside at +z, and from inside at -z: the same order of the azimuth either
    # way.
    faces = np.concatenate((np.stack((a, c, b), axis=1), np.stack((b, c, d), axis=1)))
    return Mesh(np.float32(radius * unit), faces.astype(np.int32), np.float32(sign * unit))


def pixel_centres(view_mask):
    """x, y (P, 2) of the mask's pixels: rows run down from y = +1."""
    size = len(view_mask)
    rows, columns = np.nonzero(view_mask)
    return np.stack(((columns + 0.5) * 2 / size - 1, 1 - (rows + 0.5) * 2 / size), axis=1)


def directions(text):
    return np.float32(unit(vectors(text)))


def direct_light(tracer, visible, lights, materials, patches=None):
    """Direct light (P, F) on the first of the materials, of one patch."""
    faces = np.zeros(len(tracer.mesh.faces), np.int64) if patches is None else patches
    return next(iter(render_direct(tracer, visible, lights, materials, faces).values())).numpy()


def mesh_of(corners, faces, normals):
    return Mesh(np.float32(vectors(corners)), vectors(faces).astype(np.int32), np.float32(normals))


def test_a_matte_ball_is_lambert_s_law_and_lights_nothing_of_itself():
    tracer = Tracer(ball(0.9, polar=90, inward=False))
    visible = find_visible_surface(tracer, 64, 3)
    centres = pixel_centres(visible.mask)
    assert (np.hypot(*centres.T) < 0.9).all()
    # Four fifths of the radius: the outermost pixels are cut by the outline or seen at a grazing
    # angle.
    assert visible.mask.sum() > 0.8 * np.pi * (0.45 * 64) ** 2
    x, y = (centres / 0.9).T
    normals = on_sphere(x, y)
    well_inside = normals[:, 2] > 0.4
    off = angle_between_deg(normals, visible.normals)
    assert off[well_inside].max() < 0.3
    lights = directions("0 0 1; 0.5 0.3 0.8; -0.7 0.6 0.2")
    parts = (tracer, visible, lights, matte(0.7), np.zeros(len(tracer.mesh.faces), np.int64))
    direct = direct_light(tracer, visible, lights, matte(0.7))
    expected = 0.7 * np.maximum(normals @ lights.T, 0)
    # Cells of the terminator are half lit; elsewhere the mean over a pixel is its middle's value,
    # nearly.
    assert np.abs(direct - expected)[well_inside].max() < 0.02
    assert np.abs(direct - expected)[well_inside].mean() < 0.002
    indirect = render_indirect(*parts, directions=16, bounces=3, generator=seeded(0))["matte"]
    assert indirect.abs().max() == 0


@dataclass(frozen=True)
class Cosines:
    """Radiance that tells under which cosines it was shaded: n.v in the first half of the lights,
    l.v in the second.
    """

    def take(self, pixels):
        return self

    def shade(self, n_dot_l, n_dot_v, l_dot_v):
        half = n_dot_l.shape[1] // 2
        return torch.cat((n_dot_v.expand(-1, half), l_dot_v[:, half:]), dim=1)


def test_a_ball_seen_from_a_finite_distance():
    radius, distance = 0.8, 4.0
    tracer = Tracer(ball(radius, polar=90, inward=False))
    visible = find_visible_surface(tracer, 64, 3, distance=distance)
    # The cone that touches the ball cuts the plane z = 0 in a circle of the radius d tan(asin(r /
    # d)).
    outline = distance * radius / np.sqrt(distance**2 - radius**2)
    centres = pixel_centres(visible.mask)
    assert 0.95 * outline < np.hypot(*centres.T).max() < outline
    # Where the ray from the camera through the middle of a pixel meets the ball
    rays = np.append(centres, np.zeros((len(centres), 1)), axis=1) - (0, 0, distance)
    rays = unit(rays)
    along = -distance * rays[:, 2]
    near = along - np.sqrt(along**2 - distance**2 + radius**2)
    points = (0, 0, distance) + near[:, None] * rays
    inside = (points * rays).sum(axis=1) < -0.4 * radius
    off = angle_between_deg(points / radius, visible.normals)
    assert off[inside].max() < 0.3
    lights = directions("0 0 1; 0.3 0.2 0.9; 0 0 1; -0.6 0.1 0.8")
    found = direct_light(tracer, visible, lights, {"cosines": Cosines()})
    expected = np.hstack(
        (np.tile(-(points / radius * rays).sum(axis=1)[:, None], 2), -rays @ lights[2:].T)
    )
    assert np.abs(found - expected)[inside].max() < 0.02


def floor_with_wall():
    """The floor z = 0 and a thin wall of height 0.4 that stands on x = 0.2."""
    floor, wall = "-1 -1 0; 1 -1 0; 1 1 0; -1 1 0", "0.2 -1 0; 0.2 1 0; 0.2 1 0.4; 0.2 -1 0.4"
    normals = [(0, 0, 1)] * 4 + [(-1, 0, 0)] * 4
    return mesh_of(f"{floor}; {wall}", "0 1 2; 0 2 3; 4 6 5; 4 7 6", normals)


def test_a_wall_casts_its_shadow():
    tracer = Tracer(floor_with_wall())
    visible = find_visible_surface(tracer, 50, 2)
    # At 45 degrees behind the wall the shadow is as long as the wall is high; from the front there
    # is none.
    direct = direct_light(tracer, visible, directions("1 0 1; -1 0 1"), matte(1.0))
    x = pixel_centres(visible.mask)[:, 0]
    in_shadow = (x > -0.2 + 0.04) & (x < 0.2 - 0.04)
    in_light = (x < -0.2 - 0.04) | (x > 0.2 + 0.04)
    assert np.abs(direct[in_shadow, 0]).max() == 0
    assert_allclose(direct[in_light, 0], np.sqrt(0.5), rtol=1e-5)
    beside = np.abs(x - 0.2) > 0.04
    assert_allclose(direct[beside, 1][x[beside] < 0.2], np.sqrt(0.5), rtol=1e-5)
    # Behind the wall, it is the other way round.
    behind = (x > 0.2 + 0.04) & (x < 0.6 - 0.04)
    assert np.abs(direct[behind, 1]).max() == 0


@parametrize("bounces", [1, 4])
def test_light_between_the_walls_of_a_bowl(bounces):
    # From any point of a sphere every part of it of area dA has the form factor dA / (4 pi R^2). A
    # half sphere of reflectance rho, its mouth to the light: the flux pi R^2 falls in, rho of it is
    # spread evenly, and of what is spread a half meets the bowl again.
    rho, radius = 0.8, 0.9
    tracer = Tracer(ball(radius, polar=90, inward=True))
    visible = find_visible_surface(tracer, 24, 3)
    lights = directions("0 0 1")
    parts = (tracer, visible, lights, matte(rho), np.zeros(len(tracer.mesh.faces), np.int64))
    generator = seeded(0)
    indirect = render_indirect(*parts, directions=256, bounces=bounces, generator=generator)[
        "matte"
    ].numpy()[:, 0]
    indirect /= visible.coverage
    again = rho / 2
    expected = rho * rho / 4 * (1 - again**bounces) / (1 - again)
    assert indirect.mean() == approx(expected, rel=0.02)
    # The same at the bottom and near the rim.
    distance = np.hypot(*pixel_centres(visible.mask).T)
    for part in (distance < 0.4, distance > 0.65):
        assert indirect[part].mean() == approx(expected, rel=0.05)


def test_patches_have_their_own_material():
    tracer = Tracer(floor_with_wall())
    visible = find_visible_surface(tracer, 20, 2)
    materials = {"matte": Matte(torch.tensor([[0.25], [1.0]]))}
    patch_of_face = np.array([0, 1, 0, 0])  # the floor's triangles meet on its diagonal y = x
    direct = direct_light(tracer, visible, directions("0 0 1"), materials, patch_of_face)[:, 0]
    x, y = pixel_centres(visible.mask).T
    below, above = y < x - 0.11, y > x + 0.11
    assert_allclose(direct[below], 0.25, rtol=1e-5)
    assert_allclose(direct[above], 1.0, rtol=1e-5)


def test_pixels_on_the_outline_are_as_bright_as_their_share_of_the_surface():
    corners = "-0.5 -0.5 0; 0.7 -0.5 0; 0.7 0.5 0; -0.5 0.5 0"
    tracer = Tracer(mesh_of(corners, "0 1 2; 0 2 3", [(0, 0, 1)] * 4))
    # Pixels are 0.2 wide. The edge at 0.7 leaves half of a column of pixels, which is 6 of 9
    # samples; the others are cut at their last third, or between pixels.
    visible = find_visible_surface(tracer, 10, 3)
    direct = direct_light(tracer, visible, directions("0 0 1"), matte(1.0))
    picture = np.zeros((10, 10))
    picture[visible.mask] = direct[:, 0]
    assert_allclose(picture[3:7, 3:8], 1, rtol=1e-6)
    assert visible.coverage.min() > 0.5
    assert_allclose(direct[:, 0], visible.coverage, rtol=1e-6)
    assert picture.sum() == approx(1.2 / 0.04, rel=0.1)
