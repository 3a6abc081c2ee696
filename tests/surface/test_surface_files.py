"""Files of surfaces: meshes as trimesh reads them, and GLB as glTF 2.0 requires it."""

import io
from dataclasses import replace

import numpy as np
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from pytest import approx

from glb_file import read_glb
from scenes import parametrize, refuses
from splinecli.maths.transfer import decode_transfer
from splinecli.surface.mesh import Textures, surface_mesh, with_smooth_outline
from splinecli.surface.surface_files import GRAY, Surface, encode_surface

SHAPE = (15, 20)
DEPTH = 3 * np.sin(np.arange(20) / 4) + np.arange(15)[:, None] / 5
COLOURS = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), np.uint8)


def wave(coloured=True, mask=None):
    mask = np.ones(SHAPE, bool) if mask is None else mask
    return Textures(COLOURS if coloured else None).put_on(surface_mesh(DEPTH, mask), mask)


def encode(mesh, form, *, unit="pixel", millimetres=1.0):
    return dict(encode_surface(Surface(DEPTH, mesh, unit, millimetres), [form]))


def load(content, form):
    return trimesh.load_mesh(
        io.BytesIO(content), file_type=form, process=False, maintain_order=True
    )


@parametrize("coloured", [False, True])
def test_ply_and_stl(coloured):
    mesh = wave(coloured)
    stl = load(encode(mesh, "stl")["mesh.stl"], "stl")
    assert_array_equal(stl.triangles, mesh.vertices[mesh.triangles])
    content = encode(mesh, "ply")["mesh.ply"]
    read = load(content, "ply")
    assert_array_equal(read.vertices, mesh.vertices)
    assert_array_equal(read.faces, mesh.triangles)
    # trimesh passes over the normals.
    width = 28 if coloured else 24
    body = content.partition(b"end_header\n")[2][: width * len(mesh.vertices)]
    normals = np.frombuffer(body, np.uint8).reshape(-1, width)[:, 12:24].copy().view("<f4")
    assert_allclose(normals, mesh.normals, atol=1e-6)
    assert b"property float nx\nproperty float ny\nproperty float nz\n" in content
    assert content.startswith(b"ply\nformat binary_little_endian 1.0\ncomment unit: pixel\n")
    assert read.visual.kind == ("vertex" if coloured else None)
    if coloured:
        assert_array_equal(read.visual.vertex_colors[:, :3], COLOURS.reshape(-1, 3))


@parametrize("coloured", [False, True])
def test_obj(coloured, tmp_path):
    mesh = wave(coloured)
    files = encode(mesh, "obj", unit="millimetre")
    assert sorted(files) == ["mesh.mtl", "mesh.obj", *(["mesh.png"] if coloured else [])]
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    read = trimesh.load_mesh(tmp_path / "mesh.obj", process=False, maintain_order=True)
    assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    assert_array_equal(read.faces, mesh.triangles)
    normals = [
        line.split()[1:]
        for line in files["mesh.obj"].decode().splitlines()
        if line.startswith("vn ")
    ]
    assert_allclose(np.array(normals, float), mesh.normals, atol=1e-6)
    assert_allclose(read.visual.uv, mesh.uvs * (1, -1) + (0, 1), atol=1e-6)
    if coloured:
        assert_array_equal(np.asarray(read.visual.material.image), COLOURS)


@parametrize("coloured", [False, True])
def test_glb(coloured):
    mesh = wave(coloured)
    content = encode(mesh, "glb", millimetres=2)["mesh.glb"]
    tree, arrays = read_glb(content)
    smooth = with_smooth_outline(mesh)
    assert_allclose(arrays["POSITION"], smooth.vertices * 0.002, rtol=1e-6)
    assert_array_equal(arrays["indices"], mesh.triangles)
    assert_allclose(arrays["NORMAL"], mesh.normals, atol=1e-6)
    assert_allclose(arrays["TEXCOORD_0"], smooth.uvs, atol=1e-6)
    [material] = tree["materials"]
    matte = material["pbrMetallicRoughness"]
    assert (matte["metallicFactor"], matte["roughnessFactor"], material["doubleSided"]) == (
        0,
        1,
        True,
    )
    assert ("TANGENT" in arrays, "normal" in arrays) == (False, False)  # the normals are exact
    if coloured:
        assert_array_equal(arrays["colour"], COLOURS)
    else:
        assert matte["baseColorFactor"] == approx([GRAY / 255] * 3 + [1])
    [read] = trimesh.load(io.BytesIO(content), file_type="glb").geometry.values()  # type: ignore[attr-defined]
    assert len(read.faces) == len(mesh.triangles)


def glossy(specular):
    gloss = np.uint8(np.dstack((np.full(SHAPE, 255), np.full(SHAPE, 102), np.zeros(SHAPE))))
    return replace(wave(), gloss=gloss, specular=np.float32(np.broadcast_to(specular, SHAPE)))


def test_reflectance_of_glb():
    """KHR_materials_specular has 0.04 times its colour as reflectance, and trimesh reads the rest
    as before.
    """
    specular = np.linspace(0.1, 1.6, SHAPE[1])  # 0.8 % to 12.8 %
    content = encode(glossy(specular), "glb")["mesh.glb"]
    tree, arrays = read_glb(content)
    extension = tree["materials"][0]["extensions"]["KHR_materials_specular"]
    colour = (
        decode_transfer(np.float32(arrays["specular"]) / 255, None)
        * extension["specularColorFactor"]
    )
    assert_allclose(0.04 * colour[3, :, 1], 0.08 * specular, rtol=0.02)
    assert_array_equal(arrays["colour"], COLOURS)
    assert (arrays["gloss"] == (255, 102, 0)).all()
    [read] = trimesh.load(io.BytesIO(content), file_type="glb").geometry.values()  # type: ignore[attr-defined]
    assert_array_equal(np.asarray(read.visual.material.baseColorTexture), COLOURS)
    for usual in (None, np.float32(0.5)):
        tree, _ = read_glb(
            encode(replace(glossy(np.float32(1)), specular=usual), "glb")["mesh.glb"]
        )
        assert "extensions" not in tree["materials"][0]
    tree, arrays = read_glb(encode(glossy(np.float32(0.25)), "glb")["mesh.glb"])
    assert tree["materials"][0]["extensions"]["KHR_materials_specular"] == {
        "specularColorFactor": [0.5] * 3
    }


def test_gloss_of_obj(tmp_path):
    files = encode(glossy(np.float32(0.5)), "obj")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    lines = dict(
        line.split(maxsplit=1) for line in files["mesh.mtl"].decode().splitlines() if " " in line
    )
    assert {key: lines[key] for key in ("map_Kd", "map_Pr", "map_Pm")} == {
        "map_Kd": "mesh.png",
        "map_Pr": "mesh_roughness.png",
        "map_Pm": "mesh_metalness.png",
    }
    assert (np.asarray(Image.open(tmp_path / "mesh_roughness.png")) == 102).all()
    assert not np.asarray(Image.open(tmp_path / "mesh_metalness.png")).any()
    # At a roughness of 0.4, facets of 4 % reflect 0.04 / (4 x 0.4^4) of a white matte surface in
    # the mirror direction.
    assert float(lines["Ks"].split()[0]) == approx(0.04 / (4 * 0.4**4), abs=0.003)
    assert float(lines["Ns"]) == approx(2 / 0.4**4 - 2)
    read = trimesh.load_mesh(tmp_path / "mesh.obj", process=False, maintain_order=True)
    assert_array_equal(np.asarray(read.visual.material.image), COLOURS)


def test_a_mesh_without_triangles():
    mesh = wave(mask=np.eye(*SHAPE, dtype=bool))
    assert b"element vertex 15\n" in encode(mesh, "ply")["mesh.ply"]
    assert encode(mesh, "obj")["mesh.obj"].count(b"\nv ") == 15
    assert len(encode(mesh, "stl")["mesh.stl"]) == 84
    with refuses("the mesh has no triangles, because no three pixels"):
        encode(mesh, "glb")
