"""Meshes of height maps."""

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.errors import UsageError
from splinecli.surface.mesh import SurfaceMesh, surface_mesh

CAMERA = np.array([[100.0, 0.0, 9.0], [0.0, 110.0, 7.0], [0.0, 0.0, 1.0]])


ROWS, COLUMNS = np.mgrid[:15, :20]
WAVE = 3 * np.sin(COLUMNS / 4) + ROWS / 5
COLOURS = np.random.default_rng(0).integers(0, 256, (15, 20, 3), np.uint8)
RAGGED = np.random.default_rng(1).uniform(size=(15, 20)) < 0.8
RAGGED[3, 4] = True


def face_normals(mesh: SurfaceMesh) -> NDArray[np.float64]:
    """Twice the area long (T, 3)."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)


def test_four_pixels() -> None:
    depth = np.array([[5.0, 0.0], [1.0, 4.0]])
    mesh = surface_mesh(depth, np.ones((2, 2), bool))
    np.testing.assert_array_equal(mesh.vertices, [[-0.5, 0.5, 5], [0.5, 0.5, 0], [-0.5, -0.5, 1], [0.5, -0.5, 4]])
    # The edge between pixels 0 and 3, which are nearly as high.
    assert {frozenset(triangle) for triangle in mesh.triangles.tolist()} == {frozenset({0, 2, 3}), frozenset({0, 3, 1})}
    assert (mesh.vertices.dtype, mesh.triangles.dtype, mesh.colours) == (np.float32, np.int32, None)


@pytest.mark.parametrize("mask", [np.ones((15, 20), bool), RAGGED], ids=["full", "ragged"])
def test_triangles_tile_the_mask_and_face_the_camera(mask: NDArray[np.bool_]) -> None:
    mesh = surface_mesh(WAVE, mask)
    assert len(mesh.vertices) == np.count_nonzero(mask)
    # Seen along z, half a pixel each, counter-clockwise.
    np.testing.assert_allclose(face_normals(mesh)[:, 2], 1)
    corners = mask[1:, 1:] * 1 + mask[:-1, 1:] + mask[1:, :-1] + mask[:-1, :-1]
    assert len(mesh.triangles) == 2 * np.count_nonzero(corners == 4) + np.count_nonzero(corners == 3)
    assert len({frozenset(triangle) for triangle in mesh.triangles.tolist()}) == len(mesh.triangles)


def test_perspective_vertices_project_into_their_pixels() -> None:
    depth, mask = 50 + WAVE, RAGGED
    mesh = surface_mesh(depth, mask, CAMERA)
    # OpenCV's frame: y down, z forward.
    image = mesh.vertices * (1, -1, -1) @ CAMERA.T
    rows, columns = np.nonzero(mask)
    np.testing.assert_allclose(image[:, 0] / image[:, 2], columns, atol=1e-4)
    np.testing.assert_allclose(image[:, 1] / image[:, 2], rows, atol=1e-4)
    np.testing.assert_allclose(image[:, 2], depth[mask], rtol=1e-6)
    towards_camera = -mesh.vertices[mesh.triangles].mean(axis=1)
    assert ((face_normals(mesh) * towards_camera).sum(axis=1) > 0).all()


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_steps_are_left_open(camera: NDArray[np.float64] | None) -> None:
    height = np.repeat([0.0, 10.0], [4, 5])[None] + np.zeros((6, 1))
    # A step of 10 pixels at a focal length of sqrt(100 * 110).
    depth = height if camera is None else 7 * np.exp(-height / np.sqrt(11_000))
    mask = np.ones(depth.shape, bool)
    whole = surface_mesh(depth, mask, camera)
    assert len(surface_mesh(depth, mask, camera, largest_step=10.01).triangles) == len(whole.triangles) == 80
    cut = surface_mesh(depth, mask, camera, largest_step=9.99)
    assert len(cut.triangles) == 70
    assert (np.ptp(cut.vertices[cut.triangles, 2], axis=1) < 1e-5).all()
    with pytest.raises(UsageError, match="the largest step is -1, expected"):
        surface_mesh(depth, mask, largest_step=-1)


def test_pixels_without_triangles() -> None:
    for mask in (np.eye(4, dtype=bool), np.ones((1, 5), bool)):
        mesh = surface_mesh(np.zeros(mask.shape), mask)
        assert mesh.triangles.shape == (0, 3)
        np.testing.assert_array_equal(mesh.normals, np.tile((0, 0, 1), (len(mesh.vertices), 1)))


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_attributes_of_vertices(camera: NDArray[np.float64] | None) -> None:
    colours, normal_map, mask = COLOURS, np.zeros((15, 20, 3)), RAGGED
    normal_map[..., 2] = 1
    normal_map[3, 4] = (0.6, 0, 0.8)
    mesh = surface_mesh(50 + WAVE, mask, camera, colours, normal_map=normal_map)
    np.testing.assert_array_equal(mesh.normals, normal_map[mask].astype(np.float32))
    np.testing.assert_array_equal(mesh.colours, colours[mask])
    rows, columns = np.nonzero(mask)
    expected = np.stack(((columns + 0.5) / 20, (rows + 0.5) / 15), axis=1)
    np.testing.assert_allclose(mesh.uvs, expected, atol=1e-6)
    # Outside the mask, the texture goes on with the colours of the border.
    assert {tuple(colour) for colour in mesh.texture.reshape(-1, 3)} == {tuple(c) for c in colours[mask]}


def test_normals_of_the_triangles() -> None:
    mesh = surface_mesh(0.5 * COLUMNS - 2.0 * ROWS, np.ones((15, 20), bool))
    slope = np.array((-0.5, -2, 1))
    np.testing.assert_allclose(mesh.normals, np.tile(slope / np.linalg.norm(slope), (300, 1)), atol=1e-6)
