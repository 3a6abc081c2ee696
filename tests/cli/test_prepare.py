"""`splinecli prepare`: captures, CyclesPS trees and rendered scenes, continuation, and refusals."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from capture.test_cyclesps import normals, write_object
from kills import content
from scenes import assert_unit, parametrize, put, read_image, read_json, write_image


@pytest.fixture
def cycles_images():
    """The images (F, H, W, 3) by kind of one object in the published layout, below the folder
    `cycles`.
    """
    shiny = write_object(Path("cycles/PRPS/Turtle"), "specular", "metallic", n_lights=4)
    return shiny | write_object(Path("cycles/PRPS_Diffuse/Turtle"), "diffuse", seed=1, n_lights=4)


def arrays(entry):
    return {path.stem: np.load(path) for path in (Path("set") / entry).glob("*.npy")}


def test_a_capture(run, capture, truth):
    out = "set: 1 entry of 1 scene, 448 pixels, 0 MB; overview in set/contact_sheet.png\n"
    run(f"prepare {capture} -o set", out=out, err="sphere: 448 pixels, 8 lights, sphere\n")
    found = arrays("sphere")
    mask = found["mask"]
    assert mask.shape == (24, 24)
    assert mask.sum() == 448
    assert_allclose(found["normals"], truth[mask], atol=1e-6)
    expected = (truth[mask] @ found["light_directions"].T) * 60_000 / 65_535
    assert_allclose(found["observations"], expected, atol=1e-5)


def test_a_cycles_tree_reads_to_the_values_put_in(document, cycles_images):
    summary = document("prepare cycles -o set")
    assert summary["entries"] == 3
    assert summary["scenes"] == 1
    whole, half = arrays("Turtle_diffuse"), arrays("Turtle_specular")
    # The masks are a box of 5 x 7 pixels.
    expected = {
        kind: images.mean(axis=3)[:, 1:6, 2:9] / 65535 for kind, images in cycles_images.items()
    }
    assert_allclose(whole["observations"], expected["diffuse"].reshape(4, 35).T, rtol=1e-6)
    # 16 bits
    assert_allclose(whole["normals"], normals()[1:6, 2:9].reshape(35, 3), atol=2.5e-5)
    # PRPS gives rows 2 and 4 and columns 2, 4, 6 and 8, as in the training of CNN-PS.
    inner = expected["specular"][:, 1::2, ::2].reshape(4, 8).T
    assert_allclose(half["observations"], inner, rtol=1e-6)
    assert half["mask"].shape == (4, 6)
    manifest = read_json("set/manifest.json")
    assert {entry["scene"] for entry in manifest["entries"]} == {"Turtle"}
    assert manifest["complete"] is True


def test_the_same_command_continues(run, make_capture):
    one, two = make_capture("one"), make_capture("two")
    shutil.move(two / "image3.png", "hidden.png")
    result = run(f"prepare {one} {two} -o set", input_error="two")
    # The good capture is in the set, and the bad one is named.
    assert result.out.startswith("set: 1 entry of 1 scene, 448 pixels")
    before = Path("set/one/observations.npy").stat()
    shutil.move("hidden.png", two / "image3.png")
    assert run(f"prepare {one} {two} -o set").out.startswith("set: 2 entries of 2 scenes")
    assert Path("set/one/observations.npy").stat().st_mtime_ns == before.st_mtime_ns


def test_captures_of_one_name_get_entries_of_their_own(run, make_capture):
    capture = make_capture("a")
    shutil.copytree(capture, "b/a")
    times = []
    for sources in ((capture, "b", capture), ("b", capture)):  # names stay in another order
        run("prepare -o set --quiet", *sources)
        assert {path.name for path in Path("set").iterdir() if path.is_dir()} == {"a", "a-2"}
        times.append([Path(f"set/{name}/normals.npy").stat().st_mtime_ns for name in ("a", "a-2")])
    assert times[0] == times[1]


CHANGES = {
    "ambient": lambda folder: write_image(
        folder / "ambient.png", np.full((24, 24), 600, np.uint16)
    ),
    "truth": lambda folder: np.save(
        folder / "normals_gt.npy", np.load(folder / "normals_gt.npy")[::-1]
    ),
}


@parametrize("change", CHANGES)
def test_a_changed_capture_is_named_and_read_again_with_update(run, make_capture, change):
    one, two = make_capture("one"), make_capture("two")
    run(f"prepare {one} -o set --quiet")
    before = arrays("one")
    CHANGES[change](one)
    hint = "Add --update to read it again, or choose another -o."
    message = f"one: its files changed since the entry one was made. {hint}"
    err = f"splinecli: {message}\ntwo: 448 pixels, 8 lights, two\n"
    # The stale entry is kept and named, and the other capture is added.
    summary = run(f"prepare {one} {two} -o set --json", code=5, err=err).json
    assert summary["entries"] == 2
    assert summary["skipped"] == [{"source": "one", "reason": message, "exit_code": 5}]
    assert_array_equal(arrays("one")["observations"], before["observations"])
    run(f"prepare {one} {two} -o set --update --quiet")
    after = arrays("one")
    assert any((after[name] != before[name]).any() for name in ("observations", "normals"))
    run(f"prepare {one} {two} -o set --quiet")


def test_saturated_pixels_are_restored_unless_as_stored(run, capture):
    # One light is 1.4 times as bright, so that some pixels of its image are clipped at 65535.
    picture = np.float64(read_image(capture / "image2.png"))
    write_image(capture / "image2.png", np.uint16((1.4 * picture).clip(0, 65535)))
    np.savetxt(capture / "light_intensities.txt", [[1.4 if i == 1 else 1] * 3 for i in range(8)])
    run(f"prepare {capture} -o set --quiet")
    run(f"prepare {capture} -o raw --as-stored --quiet")
    found, stored = arrays("sphere"), np.load("raw/sphere/observations.npy")
    expected = found["normals"] @ found["light_directions"].T * 60_000 / 65_535  # a matte sphere
    assert (np.abs(stored - expected).max(axis=1) > 0.01).sum() > 20
    assert_allclose(found["observations"], expected, atol=2e-3)
    # The two readings do not share an entry.
    says = "was made with reading = 'as stored', not 'restored'"
    run(f"prepare {capture} -o raw", code=5, says=says)


@pytest.fixture
def cube():
    """A cube's mesh, its top turned to the camera."""
    pytest.importorskip("embreex")
    corners = "".join(f"v {x} {y} {z}\n" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))
    sides = "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
    return put("cube.obj", corners + sides)


@pytest.mark.usefixtures("coarse_shapes")  # for speed
def test_scenes_and_a_mesh_are_rendered(run, cube):
    arguments = f"prepare --mesh {cube} --size 16 --n-lights 20 -o set"
    result = run(f"{arguments} --scenes 1")
    assert result.out.startswith("set: 18 entries of 2 scenes, ")
    assert result.err.count(", 20 lights, rendered: ") == 18
    for kind in ("diffuse", "specular", "metallic"):
        found = arrays(f"cube-{kind}")
        assert found["observations"].dtype == np.float16
        assert found["observations"].shape == (found["mask"].sum(), 20)
        assert (found["observations"] >= 0).all() and found["observations"].max() > 0
        assert_unit(found["normals"])
    # The middle of the cube's top looks at the camera.
    normal_map = np.zeros((16, 16, 3))
    normal_map[found["mask"]] = found["normals"]
    assert normal_map[7, 7, 2] > 0.9
    before = Path("set/scene0000-diffuse/observations.npy").read_bytes()
    # A larger N adds scenes and keeps the others.
    run(f"{arguments} --scenes 2 --quiet")
    assert Path("set/scene0000-diffuse/observations.npy").read_bytes() == before
    assert Path("set/scene0001-diffuse").is_dir()
    says = "the entry cube-diffuse was made with seed = 0, not 1. Choose"
    run(f"{arguments} --scenes 2 --seed 1", code=5, says=says)


def test_groups_have_the_meshes_as_bodies(run, cube, monkeypatch):
    monkeypatch.setattr("splinecli.workshop.synthesis.groups.SPACING", 0.05)
    monkeypatch.setattr("splinecli.workshop.synthesis.groups.FEWEST_FACES", 100)
    arguments = f"prepare --mesh {cube} --groups 2 --size 16 --n-lights 20 -o set"
    assert run(arguments).out.startswith("set: 18 entries of 2 scenes, ")
    manifest = read_json("set/manifest.json")
    assert {entry["scene"] for entry in manifest["entries"]} == {"group0000", "group0001"}
    assert not Path("set/cube-diffuse").exists()
    # With --views, the mesh is also rendered alone; the groups stay.
    assert run(f"{arguments} --views 1").out.startswith("set: 27 entries of 3 scenes, ")
    run(f"{arguments} --mesh cube.obj", code=5)


def test_workers_render_the_same_set(run, cube):
    pytest.importorskip("distributed")
    put("block.obj", cube.read_text())
    more = "--mesh block.obj --scenes 1"
    arguments = f"prepare --mesh {cube} --size 16 --n-lights 20"
    alone = run(f"{arguments} {more} -o alone")
    # The set has the cube already.
    run(f"{arguments} -o set -q")
    run(f"{arguments} {more} -o set --workers 2", err=alone.err)
    assert content(Path("alone")) == content(Path("set"))


def test_a_mesh_that_the_camera_cannot_see(run, cube):
    put("back.obj", "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 3 2\n")
    says = "splinecli: back.obj: no face of the mesh is visible to the camera. The camera looks"
    arguments = "prepare --mesh back.obj --size 16 --n-lights 20 -o set"
    run(arguments, code=3, out="", says=says)
    # Views from behind are drawn again.
    assert run(f"{arguments} --views 4").out.startswith("set: 36 entries")


def test_refusals(refuse, make_capture, cycles_images):
    blind = make_capture("blind")
    (blind / "normals_gt.npy").unlink()
    Path("cycles/PRPS/Turtle/images_metallic/00002.tif").unlink()
    Path("full").mkdir()
    put("full/notes.txt", "mine")
    put("cube.txt", "no mesh")
    cases = f"""
        2 -o set
        3 missing -o set
        3 {blind} -o set
        3 cycles/PRPS/Turtle/images_metallic -o set2
        5 {make_capture("good")} -o full
        3 --mesh missing.ply -o set3
        2 --scenes -1 -o set3
    """
    refuse("prepare", cases)
