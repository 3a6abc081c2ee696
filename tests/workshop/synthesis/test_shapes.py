"""Procedural shapes: sound surfaces, true normals and hollows; meshes as files give them."""

import time
import zipfile

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx

from scenes import assert_unit, parametrize, put, refuses, to_uint16, write_image
from splinecli.errors import InputError
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.workshop.synthesis import meshes
from splinecli.workshop.synthesis.meshes import (
    REACH,
    Mesh,
    read_mesh,
    split_long_edges,
)
from splinecli.workshop.synthesis.shapes import (
    KINDS,
    Relief,
    draw_detail,
    draw_shape_of_kind,
    read_relief,
)

pytest.importorskip("skimage")


def test_triangles_lie_on_the_zero_with_the_field_s_normals():
    mesh = meshes.triangulate(meshes.torus(0.6, 0.25), (1.0, 1.0, 0.5), 0.03)
    assert np.abs(meshes.torus(0.6, 0.25)(mesh.vertices)).max() < 2e-4
    ring = mesh.vertices * (1, 1, 0)
    centre = 0.6 * unit(ring)
    expected = (mesh.vertices - centre) / 0.25
    assert (expected * mesh.vertex_normals).sum(axis=1).min() > 0.9999
    # Anticlockwise from outside, closed, and of the volume 2 pi^2 R r^2.
    assert outward_volume(mesh) == approx(2 * np.pi**2 * 0.6 * 0.25**2, rel=0.01)


def test_skipping_what_is_far_from_the_surface_changes_nothing(monkeypatch, rng):
    noise = meshes.waves(rng, 1.0)

    def lumps(at):
        return np.linalg.norm(at, axis=1) - np.float32(0.6) - np.float32(0.05) * noise(at)

    sparse = meshes.triangulate(lumps, (1.0, 1.0, 1.0), 0.05)
    monkeypatch.setattr(meshes, "COARSE", 1)
    dense = meshes.triangulate(lumps, (1.0, 1.0, 1.0), 0.05)
    assert len(sparse.faces) == len(dense.faces)
    assert_allclose(outward_volume(sparse), outward_volume(dense), rtol=1e-5)


@parametrize("kind", list(KINDS))
def test_each_kind_is_sound_and_hollow(kind, monkeypatch, rng):
    # A coarser field, for speed.
    monkeypatch.setattr("splinecli.workshop.synthesis.shapes.SPACING", 0.025)
    mesh = draw_shape_of_kind(kind, default_rng(5))
    assert mesh.vertices.dtype == mesh.vertex_normals.dtype == np.float32
    assert mesh.faces.min() == 0 and mesh.faces.max() == len(mesh.vertices) - 1
    assert_unit(mesh.vertex_normals)
    assert outward_volume(mesh) > 0
    reach = np.abs(mesh.vertices[:, :2]).max()
    # A relief goes beyond the frame, so that no pixel sees its edge.
    assert reach > 1 if kind == "relief" else reach == approx(REACH, abs=1e-4)
    corners = mesh.vertices[mesh.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    agreement = (facing * mesh.vertex_normals[mesh.faces].mean(axis=1)).sum(axis=1)
    # Facets turn away from the field's normals in creases alone.
    assert np.quantile(agreement, 0.1) > 0.9
    # A convex body lies on one side of all its tangent planes; of these surfaces a good part lies
    # outside some.
    here, there = (rng.integers(len(mesh.vertices), size=4000) for _ in range(2))
    above = ((mesh.vertices[there] - mesh.vertices[here]) * mesh.vertex_normals[here]).sum(
        axis=1
    ) > 0.02
    assert above.mean() > 0.03


SIDE = 64
ALONG, DOWN = np.meshgrid((np.arange(SIDE) + 0.5) / SIDE, (np.arange(SIDE) + 0.5) / SIDE)
HEIGHT_SLOPES = np.stack(
    (0.6 * np.cos(2 * np.pi * (ALONG + DOWN)), 0.6 * np.cos(2 * np.pi * (ALONG + DOWN))), axis=2
).astype(np.float32)
"""The slopes of the height 0.3 / pi sin(2 pi (u + v)) along columns and rows."""


@parametrize("green_up", [True, False])
def test_slopes_are_found_whichever_way_green_points(tmp_path, green_up):
    normals = np.dstack((-HEIGHT_SLOPES, np.ones((SIDE, SIDE))))
    normals[..., 1] *= -1 if green_up else 1
    normals = unit(normals)
    path = tmp_path / "waves.png"
    write_image(path, to_uint16((normals + 1) / 2 * 65535)[..., ::-1])  # type: ignore[operator]
    assert_allclose(read_relief(path), HEIGHT_SLOPES, atol=1e-3)


def test_a_gray_image_is_no_relief(tmp_path):
    write_image(tmp_path / "gray.png", np.zeros((8, 8), np.uint8))
    with refuses("found a gray image, expected a normal map"):
        read_relief(tmp_path / "gray.png")


def test_a_plate_gets_the_normals_of_the_height(rng):
    relief = Relief(HEIGHT_SLOPES, np.eye(3, dtype=np.float32), period=0.5)
    places = rng.uniform(-1, 1, (500, 3)).astype(np.float32)
    places[:, 2] = 0
    up = np.tile(np.float32((0, 0, 1)), (500, 1))
    slope = 0.6 * np.cos(2 * np.pi * (places[:, 0] + places[:, 1]) / 0.5)
    expected = unit(np.stack((-slope, -slope, np.ones(500)), axis=1))
    off = angle_between_deg(relief.bend(up, places), expected)
    assert off.max() < 4.5  # half a texel of 64 along both axes


def test_no_normal_turns_away_from_the_camera():
    rng = default_rng(1)
    normals = rng.normal(size=(4000, 3)).astype(np.float32)
    normals[:, 2] = np.abs(normals[:, 2])
    normals = unit(normals)
    relief = draw_detail(6 * HEIGHT_SLOPES, 128, default_rng(3))
    bent = relief.bend(normals, np.float32(rng.uniform(-1, 1, (4000, 3))))
    assert_unit(bent)
    assert (bent[:, 2] >= np.minimum(normals[:, 2], 0.1) - 1e-3).all()
    assert angle_between_deg(bent, normals).mean() > 3


trimesh = pytest.importorskip("trimesh")


def outward_volume(mesh):
    """The volume that the faces enclose: positive where they are anticlockwise from outside."""
    a, b, c = (np.float64(mesh.vertices[mesh.faces[:, corner]]) for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def area(mesh):
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(facing, axis=1).sum() / 2)


@parametrize("ending", "ply obj stl stl_ascii off")
def test_a_ball_is_read_from_every_format_smooth_and_in_the_frame(tmp_path, ending):
    path = tmp_path / f"ball.{ending}"
    ball = trimesh.creation.icosphere(subdivisions=4, radius=17.0).apply_translation((5, -3, 40))
    ball.export(path, file_type=ending)
    mesh = read_mesh(path)
    assert mesh.vertices.dtype == mesh.vertex_normals.dtype == np.float32
    assert np.abs(mesh.vertices).max() == approx(REACH, abs=1e-3)
    # Normals interpolated along the edges of a fine ball stay within its facets' own angles.
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (outward * mesh.vertex_normals).sum(axis=1).min() > 0.999
    edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
    assert np.linalg.norm(edges, axis=2).max() <= 0.03


def test_a_mesh_far_from_the_origin_keeps_its_place(tmp_path):
    """In float32, its corners would lie on a grid as wide as itself."""
    box = trimesh.creation.box((4.0, 1.0, 2.0)).apply_translation((1e8, -1e8, 1e8))
    put(tmp_path / "far.obj", trimesh.exchange.obj.export_obj(box, digits=8))
    mesh = read_mesh(tmp_path / "far.obj")
    assert_allclose(mesh.vertices.max(axis=0), REACH * np.array((1, 0.25, 0.5)), rtol=1e-5)
    assert_allclose(mesh.vertices.min(axis=0), -mesh.vertices.max(axis=0), atol=1e-6)


def test_a_ball_inside_out_is_turned(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.invert()
    ball.export(tmp_path / "inverted.ply")
    assert outward_volume(read_mesh(tmp_path / "inverted.ply")) > 0


def test_blank_lines_are_skipped_in_a_time_that_grows_with_their_number(tmp_path):
    put(tmp_path / "blank.obj", "\n" * 2_000_000)
    started = time.process_time()
    with pytest.raises(InputError):
        read_mesh(tmp_path / "blank.obj")
    assert time.process_time() - started < 3  # the square took an hour


def test_splitting_edges_changes_neither_surface_nor_shading():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    mesh = Mesh(
        np.float32(box.vertices),
        box.faces.astype(np.int32),
        np.float32(box.vertex_normals),
    )
    fine = split_long_edges(mesh, longest=0.1)
    assert len(fine.faces) > 600
    assert area(fine) == approx(area(mesh), rel=1e-6)
    assert outward_volume(fine) == approx(outward_volume(mesh), rel=1e-6)
    assert_unit(fine.vertex_normals, 1e-6)
    # What is fine enough already stays as it is, and the number of faces has its limit.
    assert len(split_long_edges(mesh, longest=2.0).faces) == len(mesh.faces)
    assert len(split_long_edges(mesh, longest=0.01, most_faces=5000).faces) <= 5000


def test_what_is_no_mesh_is_refused_with_the_reason(tmp_path):
    for name, text, reason in (
        ("broken.ply", "ply, but not really", r"broken\.ply: not a mesh that can be read"),
        ("notes.txt", "nothing but words", "not a mesh that can be read"),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", r"points\.obj: .*(no faces|not a mesh)"),
        # A triangle seen from its edge alone, along the viewing direction, has no width in the
        # image.
        (
            "needle.obj",
            "v 0 0 0\nv 0 0 1\nv 0 0 2\nf 1 2 3\n",
            "no extent that a camera along -z could see",
        ),
        # Enlarged to fill the image, it would be infinitely deep.
        (
            "pole.obj",
            "v 0 0 0\nv 1e-39 0 1\nv 0 1e-39 2\nf 1 2 3\n",
            "no extent that a camera along -z could see",
        ),
    ):
        put(tmp_path / name, text)
        with refuses(reason):
            read_mesh(tmp_path / name)


def test_archives_and_files_of_other_formats_are_refused(tmp_path):
    ball = trimesh.creation.icosphere()
    for ending in ("zip", "ply"):
        with zipfile.ZipFile(tmp_path / f"archive.{ending}", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.ply", ball.export(file_type="ply"))
        with refuses(r"not a mesh that can be read .*is in none of these formats"):
            read_mesh(tmp_path / f"archive.{ending}")
    ball.export(tmp_path / "ball.glb")
    with refuses("Give a triangle mesh as PLY, OBJ, STL or OFF"):
        read_mesh(tmp_path / "ball.glb")


def test_large_meshes_are_refused(tmp_path, monkeypatch):
    (tmp_path / "long.obj").write_bytes(b"v 0 0 0\n" + b" " * 32_000_000)
    with refuses(r"long\.obj: found a longer file than 32 MB"):
        read_mesh(tmp_path / "long.obj")
    (tmp_path / "fan.obj").write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1 2 3" * 700)
    monkeypatch.setattr(meshes, "MOST_FACES", 2000)
    with refuses(r"fan\.obj: found 2098 triangles, expected at most 2000"):
        read_mesh(tmp_path / "fan.obj")
