"""Points of light against Lambert's law on a plane, and against Mitsuba 3."""

from typing import Any

import numpy as np
import pytest

from point_lights import render_point_lights
from splinecli.synthesis.meshes import Floats, Mesh
from splinecli.synthesis.ray_tracing import Tracer, find_visible_surface
from synthesis.test_rendering import matte

pytest.importorskip("embreex", reason="needs the extra 'render'")

SIZE = 24
POSITIONS = np.array([(1.5, 0.5, 1.6), (-0.8, 1.2, 3.0), (0.0, -2.0, 2.0)])


def height_field(heights: Floats) -> Mesh:
    """A mesh over the square from -1.1 to 1.1, (n, n), row 0 at y = -1.1."""
    n = len(heights)
    place = np.linspace(-1.1, 1.1, n)
    x, y = np.meshgrid(place, place)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack((corner, corner + 1, corner + n), 1), np.stack((corner + 1, corner + n + 1, corner + n), 1)]
    )
    slope_y, slope_x = np.gradient(heights, place, place)
    normals = np.stack((-slope_x, -slope_y, np.ones_like(x)), -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = np.stack((x, y, heights), -1).reshape(-1, 3)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32))


def render(mesh: Mesh, samples: int = 1) -> tuple[Floats, Floats, Floats]:
    """Return radiances (P, F), points (P, 3) of the first samples, and the mask."""
    tracer = Tracer(mesh)
    visible = find_visible_surface(tracer, SIZE, samples)
    patches = np.zeros(len(mesh.faces), np.int64)
    radiance = render_point_lights(tracer, visible, POSITIONS, matte(0.7), patches)["matte"]
    return radiance.numpy(), visible.samples.position[:: samples**2], visible.mask


def test_a_plane_under_a_point_of_light_follows_lamberts_law() -> None:
    """The cosine is h / d and the falloff (d0 / d)^2, so the radiance is albedo h d0^2 / d^3."""
    radiance, points, mask = render(height_field(np.full((5, 5), 0.1)))
    assert mask.all()
    distance = np.linalg.norm(POSITIONS - points[:, None], axis=2)
    expected = 0.7 * (POSITIONS[:, 2] - 0.1) * np.linalg.norm(POSITIONS, axis=1) ** 2 / distance**3
    np.testing.assert_allclose(radiance, expected, rtol=1e-5)


def test_a_ridge_throws_the_shadow_of_a_point_of_light() -> None:
    """From a lamp at (-2, 0, 1), a wall of height 0.5 at x = 0 shades the ground up to x = 2."""
    place = np.linspace(-1.1, 1.1, 221)
    wall = np.where(np.abs(place) < 0.015, 0.5, 0.0)
    mesh = height_field(np.tile(wall, (len(place), 1)))
    tracer = Tracer(mesh)
    visible = find_visible_surface(tracer, SIZE, 1)
    lamps = np.array([(-2.0, 0.0, 1.0), (-2.0, 0.0, 2.0)])  # the shadow of the second ends at x = 2 / 3
    patches = np.zeros(len(mesh.faces), np.int64)
    radiance = render_point_lights(tracer, visible, lamps, matte(0.7), patches)["matte"].numpy()
    # A low ray to the side passes the wall farther off: only the rows near the lamp's own are asked.
    x, y = visible.samples.position[:, 0], visible.samples.position[:, 1]
    middle = (np.abs(y) < 0.1) & (visible.samples.position[:, 2] < 1e-6)
    behind = middle & (x > 0.1)
    assert (radiance[behind, 0] == 0).all()
    np.testing.assert_array_equal(radiance[behind, 1] > 0, x[behind] > 2 / 3)
    assert (radiance[middle & (x < -0.1)] > 0).all()


def test_mitsuba_agrees() -> None:
    """A relief with cast shadows under points of light, without indirect light on either side."""
    mi: Any = pytest.importorskip("mitsuba", reason="Mitsuba is the oracle")
    mi.set_variant("scalar_rgb")
    place = np.linspace(-1.1, 1.1, 111)
    x, y = np.meshgrid(place, place)
    mesh = height_field(0.25 * np.sin(4 * x) * np.cos(3 * y))
    ours, _, mask = render(mesh, samples=8)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7] * 3}})
    theirs = mi.Mesh("relief", len(mesh.vertices), len(mesh.faces), properties, has_vertex_normals=True)
    parameters = mi.traverse(theirs)
    parameters["vertex_positions"] = mesh.vertices.ravel()
    parameters["vertex_normals"] = mesh.vertex_normals.ravel()
    parameters["faces"] = mesh.faces.ravel()
    parameters.update()
    for light, position in enumerate(POSITIONS):
        image = _render_with_mitsuba(mi, theirs, position)[mask]
        # Mitsuba's own noise is about 1 % of a pixel at this number of samples.
        assert np.abs(image - ours[:, light]).mean() < 0.01 * ours[:, light].mean()


def _render_with_mitsuba(mi: Any, mesh: Any, position: Floats) -> Floats:
    strength = float(np.pi * np.sum(position**2))  # radiance 1 from matte white at the origin's distance
    film = {
        "type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"},
        "pixel_format": "rgb", "component_format": "float32",
    }  # fmt: skip
    view = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    sampler = {"type": "independent", "sample_count": 256}
    sensor = {"type": "orthographic", "to_world": view, "film": film, "sampler": sampler}
    intensity = {"type": "rgb", "value": [strength] * 3}
    light = {"type": "point", "position": position.tolist(), "intensity": intensity}
    scene = {"type": "scene", "integrator": {"type": "direct"}, "sensor": sensor, "mesh": mesh, "light": light}
    return np.array(mi.render(mi.load_dict(scene)))[..., :3].mean(axis=-1)
