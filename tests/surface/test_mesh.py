"""Meshes of height maps, from blocks of pixels or decimated: relit as viewers do, they have the
measured normals.
"""

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from glb_file import read_glb
from scenes import parametrize, pinhole, refuses, tilted, vectors
from splinecli.errors import UsageError
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.pixel_grid import Blocks
from splinecli.surface import mesh as mesh_module
from splinecli.surface.mesh import Textures, decimated_mesh, surface_mesh, with_smooth_outline
from splinecli.surface.surface_files import Surface, encode_surface

CAMERA = pinhole(100, 9, 7, 110)


ROWS, COLUMNS = np.mgrid[:15, :20]
WAVE = 3 * np.sin(COLUMNS / 4) + ROWS / 5
COLOURS = default_rng(0).integers(0, 256, (15, 20, 3), np.uint8)
RAGGED = default_rng(1).uniform(size=(15, 20)) < 0.8
RAGGED[3, 4] = True


def face_normals(mesh):
    """Twice the area long (T, 3)."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)


def test_four_pixels():
    mesh = surface_mesh(np.array([[5.0, 0.0], [1.0, 4.0]]), np.ones((2, 2), bool))
    assert_array_equal(mesh.vertices, vectors("-0.5 0.5 5; 0.5 0.5 0; -0.5 -0.5 1; 0.5 -0.5 4"))
    # The edge between pixels 0 and 3, which are nearly as high.
    assert {frozenset(triangle) for triangle in mesh.triangles.tolist()} == {
        frozenset({0, 2, 3}),
        frozenset({0, 3, 1}),
    }
    assert mesh.vertices.dtype == np.float32
    assert mesh.triangles.dtype == np.int32
    assert mesh.colours is None


@parametrize("mask", [np.ones((15, 20), bool), RAGGED], ids=["full", "ragged"])
def test_triangles_tile_the_mask_and_face_the_camera(mask):
    mesh = surface_mesh(WAVE, mask)
    assert len(mesh.vertices) == np.count_nonzero(mask)
    # Seen along z, half a pixel each, counter-clockwise.
    assert_allclose(face_normals(mesh)[:, 2], 1)
    corners = mask[1:, 1:] * 1 + mask[:-1, 1:] + mask[1:, :-1] + mask[:-1, :-1]
    assert len(mesh.triangles) == 2 * np.count_nonzero(corners == 4) + np.count_nonzero(
        corners == 3
    )
    assert len({frozenset(triangle) for triangle in mesh.triangles.tolist()}) == len(mesh.triangles)


def test_perspective_vertices_project_into_their_pixels():
    depth, mask = 50 + WAVE, RAGGED
    mesh = surface_mesh(depth, mask, CAMERA)
    # OpenCV's frame: y down, z forward.
    image = mesh.vertices * (1, -1, -1) @ CAMERA.T
    rows, columns = np.nonzero(mask)
    assert_allclose(image[:, 0] / image[:, 2], columns, atol=1e-4)
    assert_allclose(image[:, 1] / image[:, 2], rows, atol=1e-4)
    assert_allclose(image[:, 2], depth[mask], rtol=1e-6)
    towards_camera = -mesh.vertices[mesh.triangles].mean(axis=1)
    assert ((face_normals(mesh) * towards_camera).sum(axis=1) > 0).all()


def test_the_outline_of_a_disc_is_round():
    rows, columns = np.mgrid[-45:46, -45:46]
    mask = np.hypot(rows, columns) < 40.3
    height = 0.01 * (rows**2 + columns**2)

    def radii(mesh):
        radius, turn = np.hypot(*mesh.vertices[:, :2].T), np.arctan2(*mesh.vertices[:, :2].T)
        assert_allclose(mesh.vertices[:, 2], 0.01 * radius**2, atol=0.15)
        assert_array_equal(np.sign(face_normals(mesh)[:, 2]), 1)
        # The outermost vertex in each of 90 sectors
        return np.array(
            [radius[(turn * 45 / np.pi).astype(int) == n].max() for n in range(-44, 45)]
        )

    plain = surface_mesh(height, mask)
    smooth = with_smooth_outline(plain)
    assert radii(smooth).std() < radii(plain).std() / 2
    assert abs(radii(smooth).mean() - radii(plain).mean()) < 0.5
    assert_allclose(smooth.vertices[:, 0] / 91 + 0.5, smooth.uvs[:, 0], atol=1e-6)


@parametrize("camera", [None, CAMERA])
def test_steps_are_left_open(camera):
    height = np.repeat([0.0, 10.0], [4, 5])[None] + np.zeros((6, 1))
    # A step of 10 pixels at a focal length of sqrt(100 * 110).
    depth = height if camera is None else 7 * np.exp(-height / np.sqrt(11_000))
    mask = np.ones(depth.shape, bool)
    whole = surface_mesh(depth, mask, camera)
    assert (
        len(surface_mesh(depth, mask, camera, largest_step=10.01).triangles)
        == len(whole.triangles)
        == 80
    )
    cut = surface_mesh(depth, mask, camera, largest_step=9.99)
    assert len(cut.triangles) == 70
    assert (np.ptp(cut.vertices[cut.triangles, 2], axis=1) < 1e-5).all()
    with refuses("the largest step is -1, expected", UsageError):
        surface_mesh(depth, mask, largest_step=-1)


@parametrize("camera", [None, CAMERA])
def test_attributes_of_vertices(camera):
    colours, normal_map, mask = COLOURS, np.zeros((15, 20, 3)), RAGGED
    normal_map[..., 2] = 1
    normal_map[3, 4] = (0.6, 0, 0.8)
    mesh = surface_mesh(50 + WAVE, mask, camera, normal_map=normal_map)
    mesh = Textures(colours).put_on(mesh, mask)
    assert_array_equal(mesh.normals, normal_map[mask].astype(np.float32))
    assert_array_equal(mesh.colours, colours[mask])
    rows, columns = np.nonzero(mask)
    expected = np.stack(((columns + 0.5) / 20, (rows + 0.5) / 15), axis=1)
    assert_allclose(mesh.uvs, expected, atol=1e-6)
    # Outside the mask, the texture goes on with the colours of the border.
    assert {tuple(colour) for colour in mesh.texture.reshape(-1, 3)} == {
        tuple(c) for c in colours[mask]
    }


def test_normals_of_the_triangles():
    mesh = surface_mesh(0.5 * COLUMNS - 2.0 * ROWS, np.ones((15, 20), bool))
    slope = np.array((-0.5, -2, 1))
    assert_allclose(mesh.normals, np.tile(slope / np.linalg.norm(slope), (300, 1)), atol=1e-6)


SIDE = 90
CAMERA_OF_SPHERE = pinhole(120, 40, 47, 130)


def measured(columns, rows):
    """Return the normals (..., 3) of a dome with relief that is finer than the triangles will
    be.
    """
    across, up = (columns - 44.5) / 60, (44.5 - rows) / 60
    x = across + 0.35 * np.sin(columns / 2.5) * np.cos(rows / 4)
    y = up + 0.35 * np.cos(columns / 3) * np.sin(rows / 2)
    return tilted(x, y)


def height_of_dome(columns, rows):
    return np.asarray(np.sqrt(np.maximum(60.0**2 - (columns - 44.5) ** 2 - (rows - 44.5) ** 2, 0)))


def dome(camera, odd=0):
    """Return what surface_mesh takes of the shape of a dome alone, and the normal map with the
    relief.
    """
    rows, columns = np.mgrid[: SIDE + odd, :SIDE].astype(float)
    mask = np.hypot(columns - 44.5, rows - 44.5) < 42
    height = height_of_dome(columns, rows)
    normal_map = measured(columns, rows) * mask[..., None]
    depth = height if camera is None else 3 - height / 125
    return (depth, mask, camera), normal_map


@pytest.fixture(
    scope="module", params=[None, CAMERA_OF_SPHERE], ids=["orthographic", "perspective"]
)
def camera(request):
    return request.param


@pytest.fixture(scope="module")
def decimated(camera):
    surface, normal_map = dome(camera)
    return decimated_mesh(
        *surface, n_triangles=len(surface_mesh(*surface).triangles) // 20, normal_map=normal_map
    )


@parametrize("step", [1, 3, 7])
def test_samples_of_blocks_are_those_of_scipy(step, rng):
    mask = np.hypot(*np.mgrid[-20:20, -25:25]) < 18
    blocks = Blocks.of_step(mask, step)
    depth = np.full(blocks.mask.shape, np.nan, np.float32)
    depth[blocks.mask] = rng.random(np.count_nonzero(blocks.mask))
    found = blocks.sample(blocks.spread(depth[blocks.mask][:, None]), *np.nonzero(mask))
    assert_allclose(found[:, 0], blocks.interpolate(depth, mask), atol=1e-6)


def test_normals_relit_from_the_file(decimated, rng):
    full = surface_mesh(*dome(None)[0])
    assert 0.04 < len(decimated.triangles) / len(full.triangles) <= 0.05
    ((_, content),) = encode_surface(Surface(np.zeros((1, 1)), decimated, "pixel", 1.0), ["glb"])
    _, arrays = read_glb(content)
    assert (arrays["TANGENT"][:, 3] == 1).all()
    # Ten points in each triangle.
    weights = rng.dirichlet((1, 1, 1), (10, len(arrays["indices"])))
    uv, smooth, tangent = (
        np.einsum("ktc,tcx->ktx", weights, arrays[name][arrays["indices"]]).reshape(
            -1, arrays[name].shape[1]
        )
        for name in ("TEXCOORD_0", "NORMAL", "TANGENT")
    )
    columns, rows = (uv * SIDE - 0.5).T
    inside = np.hypot(columns - 44.5, rows - 44.5) < 41
    # The nearest texel, read at its own place. A viewer interpolates between texels.
    columns, rows = np.rint(columns), np.rint(rows)
    texels = arrays["normal"][rows.astype(int), columns.astype(int)] / 255 * 2 - 1
    smooth, side = unit(smooth), unit(tangent[:, :3])
    lit = unit(
        np.einsum("px,pxy->py", texels, np.stack((side, np.cross(smooth, side), smooth), axis=1))
    )
    errors, without = (
        angle_between_deg(found, measured(columns, rows))[inside] for found in (lit, smooth)
    )
    # 8 bits are accurate to 0.3 degrees; half a texel is up to 4 degrees on the dome, and less on
    # average.
    assert errors.mean() < 1.0
    assert without.mean() > 10


def test_tangents_are_those_that_viewers_compute(decimated, camera):
    """MikkTSpace: the mean of the derivatives of the position along u in the triangles around a
    vertex.
    """
    corners = decimated.vertices[decimated.triangles].astype(float)
    uvs = decimated.uvs[decimated.triangles].astype(float)
    edges, steps = corners[:, 1:] - corners[:, :1], uvs[:, 1:] - uvs[:, :1]
    along_u, along_v = np.moveaxis(np.linalg.solve(steps, edges), 1, 0)
    total = np.zeros_like(decimated.vertices, dtype=float)
    np.add.at(total, decimated.triangles, unit(along_u)[:, None])
    normals, tangents = decimated.normals.astype(float), decimated.tangents
    expected = unit(total - (total * normals).sum(axis=1, keepdims=True) * normals)
    counts = np.bincount(decimated.triangles.ravel())
    error = angle_between_deg(tangents, expected)[counts >= 5]  # away from the border
    assert error.mean() < 1.5
    # Green points up in the image, against v.
    bitangents = np.cross(normals, tangents)[decimated.triangles]
    assert (np.einsum("tcx,tx->tc", bitangents, along_v) < 0).all()


def test_vertices_stay_on_the_dome_and_in_their_places(decimated, camera):
    columns, rows = (decimated.uvs * SIDE - 0.5).T
    x, y = decimated.vertices[:, 0] + 44.5, 44.5 - decimated.vertices[:, 1]
    if camera is not None:
        x, y, _ = (decimated.vertices / -decimated.vertices[:, 2:] * (1, -1, -1) @ camera.T).T
    assert_allclose(np.stack((columns, rows)), np.stack((x, y)), atol=1e-3)
    height = height_of_dome(columns, rows)
    depth = height if camera is None else -(3 - height / 125)
    scale = 1 if camera is None else 125
    assert np.abs(decimated.vertices[:, 2] - depth).mean() * scale < 0.2  # pixels


@parametrize("odd", [0, 1])
def test_blocks_of_a_large_map_have_its_shape(camera, odd, monkeypatch):
    """With few triangles asked for, those of blocks are decimated: they lie on the dome, in their
    places.
    """
    monkeypatch.setattr(mesh_module, "LARGE_MAP", 0)
    surface, normal_map = dome(camera, odd)
    mask = surface[1]
    mesh = decimated_mesh(*surface, n_triangles=300, normal_map=normal_map)
    assert mesh.normal_texture.shape == (*mask.shape, 3)
    columns, rows = (mesh.uvs * mask.shape[::-1] - 0.5).T
    found = mesh.vertices[:, 2] if camera is None else 125 * (3 + mesh.vertices[:, 2])
    near = np.hypot(columns - 44.5, rows - 44.5) < 38
    assert np.abs(found - height_of_dome(columns, rows))[near].mean() < 0.5  # pixels
    if camera is None:
        middle = (SIDE - 1 + odd) / 2
        assert_allclose(mesh.vertices[:, 0], columns - 44.5, atol=1e-3)
        assert_allclose(mesh.vertices[:, 1], middle - rows, atol=1e-3)
