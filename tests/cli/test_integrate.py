"""`splinecli integrate`: normal maps in all formats, the files, and the errors."""

import json
from copy import deepcopy
from pathlib import Path
from xml.etree import ElementTree
from zipfile import ZipFile

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from pytest import approx

from cli.conftest import read_report
from scenes import (
    BUMP_LAMPS,
    ball,
    names_in,
    parametrize,
    put,
    read_image,
    read_json,
    table,
    tilted,
    write_bump,
    write_image,
)
from splinecli.capture.formats import images
from splinecli.maths.normals import encode_picture
from splinecli.pipeline.infer import results_bytes

SHAPE = (40, 50)
CORE_3MF = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"


def sphere():
    """Return normals, heights and mask of a spherical cap of radius 30 about (24.5, 19.5)."""
    normals, _ = ball(SHAPE, 24.5, 19.5, 30)
    inside = normals[..., 2] > 0.8
    normals[~inside] = 0
    heights = np.where(inside, 30 * normals[..., 2], np.nan)
    return np.float32(normals), heights - np.nanmean(heights), inside


@pytest.fixture(autouse=True)
def here():
    normals, _, inside = sphere()
    np.save("normals.npy", normals)
    write_image("normals.png", encode_picture(normals, inside)[..., ::-1])
    write_image("directx.png", encode_picture(normals, inside, convention="directx")[..., ::-1])


def check_heights(depth):
    _, heights, inside = sphere()
    assert np.array_equal(np.isfinite(depth), inside)
    assert np.nanmean(np.abs(depth - heights)) < 0.005 * np.ptp(heights[inside])


def test_heights_and_mesh_of_a_sphere(run):
    result = run("integrate normals.npy -o out --format ply,obj,npy,tiff", err="")
    inside, depth = sphere()[2], np.load("out/depth.npy")
    assert depth.dtype == np.float32
    assert depth.shape == SHAPE
    check_heights(depth)
    assert_array_equal(tifffile.imread("out/depth.tiff"), depth)
    report = read_json("out/surface.json")
    assert report["n_pixels"] == inside.sum()
    files = "mesh.ply mesh.obj mesh.mtl depth.npy depth.tiff surface.json"
    assert " ".join(report["files"]) == files
    assert names_in("out") == set(report["files"])
    assert f"out: {inside.sum()} pixels, from " in result.out


def test_a_picture_of_the_other_convention(run):
    run("integrate directx.png --convention directx -o out --format npy")
    check_heights(np.load("out/depth.npy"))


@parametrize("given", ["", "--convention directx"], ids=["found", "given"])
@parametrize("form", "png png8 npy tiff")
def test_the_convention_of_a_folder_is_recognised(run, capture, form, given):
    """The values of .npy and .tiff have y up, whatever the green of the pictures means."""
    depths = []
    for convention, more in (("opengl", ""), ("directx", given)):
        arguments = f"--method ls --format {form} --convention {convention} -o {convention}"
        run(f"infer {capture} {arguments}")
        run(f"integrate {convention}/sphere --format npy -q {more}", out="", err="")
        depths.append(np.load(f"{convention}/sphere/depth.npy"))
    assert_allclose(*depths, atol=0.2)
    assert np.nanmax(depths[0]) - np.nanmin(depths[0]) > 1


def test_an_array_of_something_else(run, rng):
    np.save("albedo.npy", np.float32(rng.uniform(0, 0.4, (*SHAPE, 3))))
    run("integrate albedo.npy -o out", input_error="this is not a normal map")


@parametrize("where", "mask alpha")
def test_a_background_that_is_not_black(run, where):
    normals, _, inside = sphere()
    picture = encode_picture(normals, inside)[..., ::-1]
    picture[~inside] = 65_535
    cut = np.uint16(inside) * 65_535
    write_image("white.png", np.dstack([picture, cut]) if where == "alpha" else picture)
    write_image("mask.png", cut)
    arguments = "integrate white.png -o out --format npy"
    if where == "mask":
        run(arguments, input_error="this is not a normal map")
        arguments += " --mask mask.png"
    run(arguments)
    check_heights(np.load("out/depth.npy"))


def write_depth(form, depth):
    if form == "npy":
        np.save("prior.npy", depth)
    elif form == "tif":
        tifffile.imwrite("prior.tif", depth)
    else:
        exr = pytest.importorskip("OpenEXR")
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        exr.File(header, {"Z": depth}).write("prior.exr")
    return f"prior.{form}"


@parametrize("form", "npy tif exr")
def test_a_prior(run, form):
    """Its heights in millimetres decide where the surface is."""
    _, heights, inside = sphere()
    prior = write_depth(form, np.float32(np.where(inside, 0.5 * (heights + 100), np.nan)))
    arguments = f"normals.png --prior {prior} --pixel-size 0.5 -o out --format npy --json"
    report = run(f"integrate {arguments}").json
    assert report["prior"] == prior
    assert report["unit"] == "millimetre"
    assert_allclose(np.load("out/depth.npy")[inside], 0.5 * (heights + 100)[inside], atol=0.2)


def with_one(value, every=1):
    """Return the heights, or one of so many, with another value in one pixel."""
    heights = np.where(np.arange(2000).reshape(SHAPE) % every == 0, sphere()[1], np.nan)
    heights[9, 20] = value
    return heights


FIRST = ", the first in row 9, column 20."
BAD_PRIORS = {
    "size": (np.ones((3, 4), np.float32), "found a depth map of 4 x 3 pixels"),
    "integers": (np.ones(SHAPE, np.uint16), "expected floating-point numbers"),
    "vectors": (np.ones((*SHAPE, 2), np.float32), "expected floating-point numbers"),
    "nothing": (np.full(SHAPE, np.nan, np.float32), "the prior has no value in the mask"),
    "larger than squares": (sphere()[1] * 1e200, "values of the prior are beyond 1e+07"),
    "one of 1e60": (with_one(1e60), f"values of the prior are beyond 1e+07{FIRST}"),
    "one of 1e6": (with_one(1e6), f"than 3 times the width of the object{FIRST}"),
    "one among few": (with_one(1e6, 97), f"than 3 times the width of the object{FIRST}"),
    "negated": (-np.float32(sphere()[1]), "the prior is -"),
}


@parametrize("case", BAD_PRIORS)
def test_a_bad_prior(run, case):
    prior, message = BAD_PRIORS[case]
    np.save("prior.npy", prior)
    run("integrate normals.png --prior prior.npy -o out", input_error=message)
    assert not Path("out/surface.json").exists()


@parametrize("form", "npy tif exr")
def test_a_damaged_prior(run, form):
    """The libraries print warnings, which belong neither to stdout nor to stderr."""
    prior = Path(write_depth(form, np.ones(SHAPE, np.float32)))
    whole = prior.read_bytes()
    for content in (b"\x93NUMPY\x01\x00garbage", whole[: len(whole) // 2]):
        prior.write_bytes(content)
        result = run(f"integrate normals.png --prior {prior} -o out", input_error=prior.name)
        assert result.out == ""
        assert result.err.count("\n") == 1
    run("integrate normals.png --prior-detail 9 -o out", code=2)


VIEWS = {
    "millimetres": "--pixel-size 0.5",
    "scale": "--scale 1/2 --pixel-size 0.5",
    "crop": "--crop 4,2,16,18 --pixel-size 0.5",
    "discontinuity": "--discontinuity 0",
    "near": "--light-positions lamps.txt --pixel-size 2",
    "near camera": "--scale 1/2 --camera-matrix camera.txt",
    "perspective": "--light-positions lamps.txt --pixel-size 2 --camera-matrix camera.txt",
}


@parametrize("view", VIEWS)
def test_a_folder_of_results_gives_the_surface_of_infer(run, capture, view):
    """Camera, pixel size, frame and discontinuity of the results are in their report."""
    import trimesh

    np.savetxt("lamps.txt", BUMP_LAMPS)
    put("camera.txt", "100 0 15.5\n0 100 15.5\n0 0 1\n")
    folder = write_bump(Path("bump")) if "lamps.txt" in VIEWS[view] else capture
    arguments = "--method ls --maps albedo --surface --json"
    [report] = run(f"infer {folder} {VIEWS[view]} {arguments}").json
    Path("camera.txt").unlink()
    places = (Path("out") / folder, Path("again"))
    again = run(f"integrate {places[0]} -o again --format ply,glb,npy --json").json
    assert {name: again[name] for name in report["surface"]} == report["surface"]
    # Normals that are read are scaled to unit length again, which may change their last bit.
    depths = [np.load(place / "depth.npy") for place in places]
    assert_allclose(*depths, rtol=1e-5, atol=1e-5)
    for name in ("mesh.ply", "mesh.glb"):
        one, other = (trimesh.load(place / name, force="mesh", process=False) for place in places)
        assert_allclose(one.vertices, other.vertices, rtol=1e-5, atol=1e-5)  # type: ignore[attr-defined]
        assert_array_equal(one.faces, other.faces)  # type: ignore[attr-defined]


@parametrize("size", ["--pixel-size 2e-9", "--object-width 64e-9"])
def test_the_unit_of_lamps_is_not_that_of_the_surface(document, size):
    """Lamps in a unit in which pixels are smaller than any in millimetres."""
    np.savetxt("lamps.txt", 1e-9 * BUMP_LAMPS)
    write_bump(Path("bump"))
    document(f"infer bump --method ls --light-positions lamps.txt {size}")
    report = document("integrate out/bump --format npy")
    assert report["unit"] == "pixel"
    assert report["pixel_size_mm"] is None


def test_a_part_in_colour_by_perspective(run):
    trimesh = pytest.importorskip("trimesh")
    write_image("half.png", np.tile(np.uint8(255) * (np.arange(SHAPE[1]) < 25), (SHAPE[0], 1)))
    write_image("red.png", np.tile(np.uint8((0, 0, 200)), (*SHAPE, 1)))  # in OpenCV's order
    put("camera.txt", "200 0 24.5\n0 200 19.5\n0 0 1\n")
    options = "--mask half.png --colours red.png --camera-matrix camera.txt"
    report = run(f"integrate normals.npy {options} -o out --json").json
    assert report["camera"] == "perspective"
    depth = np.load("out/depth.npy")
    assert np.isnan(depth[:, 25:]).all()
    assert np.nanmin(depth) > 0
    mesh = trimesh.load("out/mesh.ply", process=False)
    assert (mesh.visual.vertex_colors[:, :3] == (200, 0, 0)).all()
    assert (mesh.vertices[:, 2] < 0).all()  # before the camera, which looks along -z
    # A pixel without a size counts as a millimetre. Columns 7 to 24 are on the object.
    assert trimesh.load("out/mesh.glb").extents[0] == approx(0.017, rel=0.05)
    sized = run(f"integrate normals.npy {options} -o sized --pixel-size 2 --json").json
    assert sized["unit"] == "millimetre"
    assert sized["pixel_size_mm"] == 2
    assert sized["range"] == approx(np.multiply(report["range"], 200 * 2), rel=1e-6)


def test_millimetres_in_the_files(run):
    import trimesh

    arguments = "--pixel-size 0.5 --format glb,ply,stl,npy --json"
    report = run(f"integrate normals.npy -o out {arguments}").json
    _, heights, inside = sphere()
    columns = np.flatnonzero(inside.any(axis=0))
    width_mm, depth = 0.5 * float(np.ptp(columns)), np.load("out/depth.npy")
    assert np.nanmax(depth) - np.nanmin(depth) == approx(0.5 * np.ptp(heights[inside]), rel=0.02)
    assert report["range"] == approx([np.nanmin(depth), np.nanmax(depth)], rel=1e-6)
    # The outline of the glTF file is smoothed.
    for name, unit_mm, rel in (("ply", 1, 1e-4), ("stl", 1, 1e-4), ("glb", 1000, 0.03)):
        extents = trimesh.load(f"out/mesh.{name}").extents * unit_mm
        assert extents[[0, 2]] == approx([width_mm, np.ptp(report["range"])], rel=rel), name
    assert b"\ncomment unit: millimetre\n" in Path("out/mesh.ply").read_bytes()


def test_a_solid_in_the_files(run):
    """The meshes of a cap are watertight, and have its volume in millimetres."""
    import trimesh

    run("integrate normals.npy -o out --pixel-size 0.5 --solid 3 --format glb,ply,obj,stl,3mf")
    assert read_json("out/surface.json")["solid_mm"] == 3
    with ZipFile("out/mesh.3mf") as package:
        model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    assert model.attrib["unit"] == "millimeter"
    vertices, faces = (
        [list(row.attrib.values()) for row in model.iter(f"{{{CORE_3MF}}}{name}")]
        for name in ("vertex", "triangle")
    )
    solids = [trimesh.Trimesh(np.array(vertices, float), np.array(faces, int), process=False)]
    for name in ("mesh.stl", "mesh.ply", "mesh.obj", "mesh.glb"):
        solids.append(trimesh.load(Path("out", name), force="mesh"))
    solids[-1].apply_scale(1000)
    _, heights, inside = sphere()
    above = 0.5 * (heights - heights[inside].min()) + 3
    squares = np.stack((above[:-1, :-1], above[1:, :-1], above[:-1, 1:], above[1:, 1:]))
    area = {4: 0.25, 3: 0.125}  # in mm^2, of squares of four and three pixels
    volume = sum(
        area[len(corners)] * corners.mean()
        for corners in (square[np.isfinite(square)] for square in squares.reshape(4, -1).T)
        if len(corners) >= 3
    )
    for solid in solids:
        assert solid.is_watertight
        assert solid.volume == approx(volume, rel=0.01)
    says = "the surface has no scale", "--pixel-size"
    run("integrate normals.npy -o flat --solid 3", usage_error=says)
    run("integrate normals.npy --solid 3 --format png", usage_error="--format names no mesh")


def test_a_picture_of_the_depth(run):
    arguments = "--format npy,png --pixel-size 0.5 --json"
    report = run(f"integrate normals.npy -o out {arguments}").json
    picture, depth = read_image("out/depth.png"), np.load("out/depth.npy")
    low, high = report["range"]
    assert picture.dtype == np.uint16
    assert report["unit"] == "millimetre"
    assert_array_equal(picture == 0, np.isnan(depth))
    inside = picture > 0
    read = low + (picture[inside] - 1.0) / 65_534 * (high - low)
    assert_allclose(read, depth[inside], atol=(high - low) / 65_534)
    assert picture[inside].min() == 1
    assert picture.max() == 65_535
    with Image.open("out/depth.png") as opened:
        assert f"1 = {low:.7g}, 65535 = {high:.7g}; unit: millimetre" in opened.info["depth"]


def test_the_angle_of_a_levelled_surface_is_printed(run):
    up = np.full((20, 30), np.tan(np.radians(5)), np.float32)
    np.save("tilted.npy", tilted(0 * up, up))
    err = "The surface was levelled by 5.00 degrees\n"
    run("integrate tilted.npy -o out --level plane", err=err)


def test_a_surface_that_cannot_be_is_refused_before_the_work(capture, run, monkeypatch):
    """A mesh without triangles, and one that takes more memory than there is, have one message
    before the work.
    """
    mask = np.zeros((24, 24), np.uint8)
    mask[8:16, 12] = 255  # a line
    write_image("line.png", mask)
    says = "sphere: the mesh has no triangles", "or omit --surface"
    run(f"infer {capture} --method ls --mask line.png --surface", input_error=says)
    assert not Path("out/sphere/report.json").exists()

    run(f"infer {capture} --method ls --overwrite")
    n_pixels = read_report()["n_pixels"]
    assert results_bytes(n_pixels, 5, surface=True) - results_bytes(n_pixels, 5) == n_pixels * 600
    monkeypatch.setattr(images, "available_memory", lambda: n_pixels * 600.0)
    run("integrate out/sphere")
    monkeypatch.setattr(images, "available_memory", lambda: n_pixels * 600.0 - 1)
    run("integrate out/sphere --overwrite", input_error=f"the surface of {n_pixels} pixels takes")


DAMAGED_REPORTS = """
options | crop | 5
options | scale | 3
options | pixel_size | [1]
options | convention | null
options | discontinuity | -1
 | options | 7
 | options | {}
 | files | ["normals.npy", 5]
 | file_sizes | 7
 | camera_matrix | [[0, 0, 0], [0, 0, 0], [0, 0, 0]]
 | camera_matrix | 1
 | near_lamps | 1
 | near_lamps | {"camera": "perspective", "camera_matrix": [[0, 0, 0], [0, 0, 0], [0, 0, 0]]}
"""


def test_a_damaged_report_is_named(run, capture):
    run(f"infer {capture} --method ls --format npy --surface")
    path = Path("out", capture, "report.json")
    whole = read_json(path)
    for where, key, value in table(DAMAGED_REPORTS):
        report = deepcopy(whole)
        (report[where] if where else report)[key] = json.loads(value)
        put(path, json.dumps(report))
        problem = (
            " is damaged" if "file" in key else ": the report is damaged, or from another version"
        )
        says = f"report.json{problem}"
        assert run(f"integrate {path.parent} -o again", input_error=says).err.count("\n") == 1


def test_refusals(refuse):
    np.save("flat.npy", np.ones(SHAPE))
    dot, corner = np.zeros((*SHAPE, 3), np.float32), np.zeros(SHAPE, np.uint8)
    dot[3, 3, 2], corner[0, 0] = 1, 255
    np.save("dot.npy", dot)
    write_image("small.png", np.full((10, 10), 255, np.uint8))
    write_image("corner.png", corner)
    put("camera.txt", "200 0 24.5\n0 200 19.5\n")
    put("mirrored.txt", "-200 0 24.5\n0 200 19.5\n0 0 1\n")
    Path("done").mkdir()
    Path("done/mesh.ply").touch()
    cases = """
        2 -o out
        2 normals.npy --format fbx -o out
        2 normals.npy --discontinuity -1 -o out
        2 normals.npy --pixel-size 0 -o out
        2 normals.npy --decimate 0 -o out
        3 dot.npy -o out
        3 missing.npy -o out
        3 done -o out
        3 flat.npy -o out
        3 normals.npy --mask small.png -o out
        3 normals.npy --mask corner.png -o out
        3 normals.npy --colours small.png -o out
        3 normals.npy --camera-matrix camera.txt -o out
        3 normals.npy --camera-matrix mirrored.txt -o out
        5 normals.npy -o done
    """
    refuse("integrate", cases)
    assert not Path("out").exists()
