"""Meshes as files give them, and as rendering needs them."""

import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splinecli.errors import InputError
from splinecli.synthesis import meshes
from splinecli.synthesis.meshes import REACH, Mesh, fit_to_frame, read_mesh, split_long_edges

trimesh: Any = pytest.importorskip("trimesh", reason="needs the extra 'render'")


def outward_volume(mesh: Mesh) -> float:
    """The volume that the faces enclose: positive where they are anticlockwise from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def area(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(facing, axis=1).sum() / 2)


@pytest.mark.parametrize("ending", ["ply", "obj", "stl", "stl_ascii", "off"])
def test_a_ball_is_read_from_every_format_smooth_and_in_the_frame(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"ball.{ending}"
    ball = trimesh.creation.icosphere(subdivisions=4, radius=17.0).apply_translation((5, -3, 40))
    ball.export(path, file_type=ending)
    mesh = read_mesh(path)
    assert mesh.vertices.dtype == mesh.vertex_normals.dtype == np.float32
    assert np.abs(mesh.vertices).max() == pytest.approx(REACH, abs=1e-3)
    # Normals interpolated along the edges of a fine ball stay within its facets' own angles.
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (outward * mesh.vertex_normals).sum(axis=1).min() > 0.999
    edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
    assert np.linalg.norm(edges, axis=2).max() <= 0.03


def test_the_wider_side_fits_and_the_shape_is_kept() -> None:
    box = trimesh.creation.box((4.0, 1.0, 2.0))
    vertices = box.vertices.astype(np.float32) + np.float32(3)
    mesh = fit_to_frame(Mesh(vertices, box.faces.astype(np.int32), box.vertex_normals.astype(np.float32)))
    extent = np.ptp(mesh.vertices, axis=0)
    np.testing.assert_allclose(extent, 2 * REACH * np.array((1, 0.25, 0.5)), rtol=1e-5)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), -mesh.vertices.max(axis=0), atol=1e-6)


def test_a_ball_inside_out_is_turned(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.invert()
    ball.export(tmp_path / "inverted.ply")
    assert outward_volume(read_mesh(tmp_path / "inverted.ply")) > 0


def test_blank_lines_are_skipped_in_a_time_that_grows_with_their_number(tmp_path: Path) -> None:
    (tmp_path / "blank.obj").write_text("\n" * 2_000_000)
    started = time.process_time()
    with pytest.raises(InputError):
        read_mesh(tmp_path / "blank.obj")
    assert time.process_time() - started < 3  # the square took an hour


def test_splitting_edges_changes_neither_surface_nor_shading() -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    mesh = Mesh(box.vertices.astype(np.float32), box.faces.astype(np.int32), box.vertex_normals.astype(np.float32))
    fine = split_long_edges(mesh, longest=0.1)
    assert len(fine.faces) > 600
    assert area(fine) == pytest.approx(area(mesh), rel=1e-6)
    assert outward_volume(fine) == pytest.approx(outward_volume(mesh), rel=1e-6)
    np.testing.assert_allclose(np.linalg.norm(fine.vertex_normals, axis=1), 1, atol=1e-6)
    # What is fine enough already stays as it is, and the number of faces has its limit.
    assert len(split_long_edges(mesh, longest=2.0).faces) == len(mesh.faces)
    assert len(split_long_edges(mesh, longest=0.01, most_faces=5000).faces) <= 5000


def test_what_is_no_mesh_is_refused_with_the_reason(tmp_path: Path) -> None:
    for name, text, reason in (
        ("broken.ply", "ply, but not really", r"broken\.ply: not a mesh that can be read"),
        ("notes.txt", "nothing but words", "not a mesh that can be read"),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", r"points\.obj: .*(no faces|not a mesh)"),
        # A triangle seen from its edge alone, along the viewing direction, has no width in the image.
        ("needle.obj", "v 0 0 0\nv 0 0 1\nv 0 0 2\nf 1 2 3\n", "no extent that a camera along -z could see"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=reason):
            read_mesh(tmp_path / name)


def test_archives_and_files_of_other_formats_are_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere()
    for ending in ("zip", "ply"):
        with zipfile.ZipFile(tmp_path / f"archive.{ending}", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.ply", ball.export(file_type="ply"))
        with pytest.raises(InputError, match=r"not a mesh that can be read .*is in none of these formats"):
            read_mesh(tmp_path / f"archive.{ending}")
    ball.export(tmp_path / "ball.glb")
    with pytest.raises(InputError, match="Give a triangle mesh as PLY, OBJ, STL or OFF"):
        read_mesh(tmp_path / "ball.glb")


def test_large_meshes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "long.obj").write_bytes(b"v 0 0 0\n" + b" " * 32_000_000)
    with pytest.raises(InputError, match=r"long\.obj: found a longer file than 32 MB"):
        read_mesh(tmp_path / "long.obj")
    (tmp_path / "fan.obj").write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1 2 3" * 700)
    monkeypatch.setattr(meshes, "MOST_FACES", 2000)
    with pytest.raises(InputError, match=r"fan\.obj: found 2098 triangles, expected at most 2000"):
        read_mesh(tmp_path / "fan.obj")
