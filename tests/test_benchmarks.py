"""Benchmarks run to their end on small inputs and print every row."""

import importlib
import math
import re
import shutil
import time
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pytest import approx
from safetensors.numpy import load_file
from torch.testing import assert_close

from scenes import ball, parametrize, read_json
from splinecli import __version__
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import load_weights, resolve_weights
from splinecli.judge.judge_net import CLASSES, JudgeNet
from splinecli.lights.light_net import INPUTS, LIGHT_FORMAT, SIDE, LightNet
from splinecli.materials.material_net import MATERIAL_FORMAT, MaterialNet
from splinecli.maths.normals import unit
from splinecli.system.weight_files import load_module
from splinecli.workshop.pixel_sets.store import Pixels, PixelSetWriter
from splinecli.workshop.save_weights import save_weights
from splinecli.workshop.synthesis.scenes import SceneConfig

ROOT = Path(__file__).resolve().parents[1]
MEDALLION = str(ROOT / "examples/medallion")


@pytest.fixture
def run(capsys):
    """Run a benchmark, run("name --option value"), and return what it prints."""

    def run_benchmark(command):
        name, *arguments = command.split()
        importlib.import_module(name).main(arguments)
        return capsys.readouterr().out

    return run_benchmark


def numbers(line):
    return [
        float(number)
        for number in re.findall(r"(?<![\w-])\d+(?:\.\d+)?(?![\w-])", line.replace(",", ""))
    ]


SPEEDS = {
    "training_speed --batch-size 4 --steps 1 --warm-up 1 --device cpu": (
        "compact|compact, Ls and La|compact, alternating|paper|cnn-ps"
    ),
    "inference_speed --pixels 64 --repeats 1": (
        "layers of the paper|spline-net-pixelwise|spline-net-pixelwise"
    ),
}


@parametrize("command", SPEEDS)
def test_speeds(run, command):
    printed, names = run(command).splitlines()[1:], SPEEDS[command].split("|")
    assert all(line.startswith(name) for line, name in zip(printed, names, strict=True))
    assert all(min(numbers(line[25:])) > 0 for line in printed)


def test_photographs(run):
    printed = run(f"photographs {MEDALLION} --draws 1 --pixels 60")
    overexposed, intensities = printed.split("\n\n")
    assert len(numbers(overexposed.splitlines()[1])) == 4
    assert len(numbers(intensities.splitlines()[1])) == 7


@pytest.mark.usefixtures("coarse_shapes")
def test_faulty_captures(run, tmp_path, monkeypatch):
    monkeypatch.setattr("fit_capture_confidence.STEPS", 20)
    assert int(run(f"faulty_captures {tmp_path} --scenes 5 --size 24").split()[0]) > 5
    rows = run(f"fit_capture_confidence {tmp_path}").splitlines()
    assert rows[0].startswith("| capture | number | claimed before")
    assert "right" in rows[2] + rows[-1] + rows[-2]
    assert all(len(numbers(row)) == 8 for row in rows[2:])


@pytest.mark.usefixtures("coarse_shapes")
def test_render_accuracy(run):
    pytest.importorskip("mitsuba", reason="compares with Mitsuba 3")
    arguments = "--size 12 --samples 4 --scenes 1 --directions 4"
    printed = run(f"render_accuracy {arguments}").splitlines()
    assert [line.split()[0] for line in printed[2:5]] == ["diffuse", "specular", "metallic"]
    assert printed[-1].count("%") == 3


@pytest.mark.usefixtures("coarse_shapes")
def test_near_lamps(run):
    printed = run("near_lamps --size 16 --method ls --widths 4 --off 0.8").splitlines()
    assert len(printed) == 8
    plane = next(row for row in printed if row.split()[:2] == ["matte", "plane"])
    distant, distant_range, as_distant, bowl, near, near_range, *_ = numbers(plane)
    assert as_distant > 5 > 1 > near
    assert bowl > 5 > 1 > near_range
    assert distant < 1 > distant_range


def test_surfaces_of_flat_things(run):
    """Tilts by unknown intensities are levelled; bends by near lamps need the positions."""
    pytest.importorskip("embreex")
    rows = run("surfaces --flat --size 24 --method ls").splitlines()
    assert len(rows) == 9
    for row in rows:
        distant, unequal, levelled, _, near, near_levelled, _, given = numbers(row)
        assert distant < 30 > levelled < unequal
        assert near > 60 < near_levelled
        assert given < 30


def test_inspection(run):
    printed = run("inspection --size 96 --plates 1 --depths 0.5 --method ls").splitlines()
    assert printed[2:] == [f"| {name} | 0.5 | 4 of 4 | 4 of 4 |" for name in ("dent", "scratch")]


def test_large_captures(run, tmp_path):
    plot = tmp_path / "plot.png"
    arguments = f"--megapixels 0.001 --method ls --plot {plot}"
    header, row = run(f"large_captures {arguments}").splitlines()
    assert header.split()[0] == "megapixels"
    assert numbers(row)[0] == approx(0.001, abs=2e-4)
    assert row.endswith("exact")
    assert plot.stat().st_size > 1000


def test_gpu_session(tmp_path):
    """A step that fails, or has no time left, is reported, and the others go on."""
    module = importlib.import_module("gpu_session")
    session = module.Session(tmp_path, tmp_path, time.time() + 60)
    normals = np.broadcast_to((0.0, 0.6, 0.8), (2, 2, 3))
    np.save(tmp_path / "one.npy", normals)
    np.save(tmp_path / "other.npy", normals[..., [0, 2, 1]])
    one, other = str(tmp_path / "one.npy"), str(tmp_path / "other.npy")
    found = session.step("apart", module.normals_apart, one, other, seconds=60)
    turned = math.degrees(math.asin(0.8) - math.asin(0.6))
    assert (found["mean_deg"], found["max_deg"]) == approx((turned, turned))
    assert session.step("missing", module.normals_apart, one, f"{other}.gz", seconds=60) is None
    session.ends = time.time()
    assert session.step("late", module.normals_apart, one, other, seconds=60) is None
    report = (tmp_path / "report.txt").read_text()
    assert report.count("FAILED") >= 2 and "FileNotFoundError" in report
    assert "there is no time left" in report
    steps = [entry["step"] for entry in read_json(tmp_path / "report.json")]
    assert steps == ["apart", "missing", "late"]


def test_all_figures(run, tmp_path):
    """A row is stored with what it was measured with, and is not measured again."""
    for name in ("ballPNG", "catPNG", "readingPNG"):
        place = tmp_path / "data/DiLiGenT/pmsData" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(MEDALLION)
    stored = tmp_path / "figures.json"
    command = f"all_figures {tmp_path}/data --results {tmp_path}/results --figures {stored}"
    assert run(f"{command} --trials 2 --only noise/ls").startswith("noise, ls: ")
    measured = read_json(stored)["noise"]
    assert measured["version"] == __version__
    assert len(measured["weights"]) == 8
    assert list(measured["rows"]) == ["ls"]
    assert list(measured["rows"]["ls"]) == ["0", "2", "4", "8"]
    assert measured["rows"]["ls"]["0"] < measured["rows"]["ls"]["8"]
    assert run(f"{command} --trials 2 --only noise/ls") == ""


def test_weights_are_combined_and_compared(run, make_set, tmp_path):
    make_set()
    other, joined, mean = (tmp_path / f"{name}.safetensors" for name in ("other", "joined", "mean"))
    network = resolve_weights("spline-net").network
    shipped = {name: values.clone() for name, values in network.state_dict().items()}
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.5
    save_weights(network, other)
    run(f"combine_weights join {other} spline-net {joined}")
    run(f"combine_weights mean {joined} spline-net {mean}")
    found, between = (load_weights(path).network.state_dict() for path in (joined, mean))
    for name in shipped.keys() - {"cells"}:
        added = 0.5 * (not name.startswith("refine_net."))
        assert torch.allclose(found[name], shipped[name] + added, atol=1e-2), name
        assert torch.allclose(between[name], shipped[name] + added / 2, atol=1e-2), name
    command = f"unseen_scenes {tmp_path}/set --captures 2 --weights"
    rows = [numbers(line) for line in run(f"{command} spline-net {joined}").splitlines()]
    errors, changes = zip(*[(row[0], row[2]) for row in rows if len(row) == 4], strict=True)
    assert changes[:2] == (0, 0) and min(changes[2:]) > 50 and 0 < errors[0] < 60


def test_wrong_lights(run):
    rows = run(f"wrong_lights {MEDALLION} --scenes 0 --draws 1").splitlines()
    cells = dict(
        row.strip("| ").split(" | ") for row in rows if row.count("|") == 3 and "---" not in row
    )
    assert cells.pop("light file") == "medallion"
    assert cells.pop("right") == "0 of 1"
    assert len(cells) == 9
    assert sum(cell == "1 / 1 of 1" for cell in cells.values()) >= 8


def test_measured_spheres(run, shared_data, tmp_path):
    """Trained weights are better on measured materials than a network without training, which is a
    Lambertian fit.
    """
    lights = shared_data / "DiLiGenT/pmsData/ballPNG/light_directions.txt"
    materials = shared_data / "merl_nbrdf/merl_nbrdf.npz"
    untrained = tmp_path / "untrained.safetensors"
    save_weights(SplineNet(NetworkConfig()), untrained)
    arguments = f"--weights spline-net --weights {untrained} --draws 1 --pixels 4"
    printed = run(f"measured_spheres {materials} {lights} {arguments}").splitlines()
    trained, fit = (float(re.findall(r": (\S+) degrees", line)[0]) for line in printed)
    assert trained < 0.7 * fit


@pytest.mark.usefixtures("coarse_shapes")
def test_materials(run):
    printed = run("materials --scenes 1 --size 16 --sets metallic").splitlines()
    assert "material" in printed[0]
    assert [line.split("|")[1].strip() for line in printed[3:5]] == ["all", "highlight observable"]


@pytest.mark.usefixtures("coarse_shapes")
def test_judgement(run, tmp_path):
    """Captures are the same at each run, and each is measured once."""
    made, found = tmp_path / "made", tmp_path / "found"
    counts = "--right 2 --faulty 4"
    run(f"judgement render {made} {counts} --part 1/2")
    first = (made / "000.right.file/im_01.png").read_bytes()
    shutil.rmtree(made / "000.right.file")
    run(f"judgement render {made} {counts}")
    assert (made / "000.right.file/im_01.png").read_bytes() == first
    assert read_json(made / "003.tilt.15/truth.json")["kind"] == "tilt"
    run(f"judgement measure {made} {found} --method ls")
    stored = sorted(found.glob("*.json"))
    assert len(stored) == 6
    measured = stored[0].stat().st_mtime_ns
    run(f"judgement measure {made} {found} --method ls")
    assert stored[0].stat().st_mtime_ns == measured
    assert all(read_json(path)["mae"] < 60 for path in stored)
    printed = run(f"judgement report {found}")
    assert "| tilt | 3 | " in printed
    assert run(f"judgement report {found} {found}") == printed


TINY = SceneConfig(size=16, lights=40, samples=1, directions=4, bounces=1)


def write_shapes(folder):
    """Write a mesh, and a normal map in the folder relief/."""
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(3).export(folder / "mesh.ply")
    (folder / "relief").mkdir(exist_ok=True)
    flat = np.full((16, 16, 3), (255, 128, 128), np.uint8)
    cv2.imwrite(str(folder / "relief" / "flat.jpg"), flat)


@pytest.mark.usefixtures("coarse_shapes")
def test_train_light_net(run, tmp_path, monkeypatch, rng):
    """It renders scenes of all kinds, and learns the lights of matte spheres, also after an
    interruption. The shipped network knows these lights, and is where training starts from.
    """
    writer = PixelSetWriter(tmp_path / "set")
    lights = np.float32(unit(rng.normal(size=(64, 3)) * (1, 1, 0.2) + (0, 0, 1)))
    for name, radius in (("a", 19), ("b", 18)):
        normals, mask = ball((40, 40), 19.5, 19.5, radius)
        observations = np.float32((normals[mask] @ lights.T).clip(0))
        writer.add(name, name, "", {}, Pixels(observations, normals[mask], lights, mask))
    writer.finish()
    *_, row, expected = run(f"unknown_lights {tmp_path}/set --captures 1").splitlines()
    _, answered, mean, *_ = numbers(row)
    assert answered == 100 and mean < 5 and "100% of 3" in expected
    monkeypatch.setattr("train_light_net.IMAGES_PER_STEP", 8)
    out = tmp_path / "net.safetensors"
    errors = [
        numbers(run(f"train_light_net train {tmp_path}/set --steps {steps} -o {out}").split()[1])[0]
        for steps in (1, 250)
    ]
    assert errors[1] < 0.7 * errors[0]
    load_module(LightNet(), out, LIGHT_FORMAT)
    shipped = files("splinecli") / "assets" / "light-net.safetensors"
    options = f"--steps 1 -o {tmp_path}/known.safetensors --start-from {shipped}"
    known = run(f"train_light_net train {tmp_path}/set {options}")
    assert numbers(known.split()[1])[0] < errors[1]

    network, images = LightNet(), torch.rand(1, 5, INPUTS, SIDE, SIDE)
    state = network.state_dict()
    widen = importlib.import_module("train_light_net").widen
    widen(deeper := LightNet(), {n: v for n, v in state.items() if ".3." not in n})
    for values in (network.local[3], network.middle[3]):
        torch.nn.init.zeros_(values.weight)
        torch.nn.init.zeros_(values.bias)
    assert_close(deeper(images), network(images))
    with pytest.raises(KeyError):
        widen(deeper, {})

    monkeypatch.setattr("train_light_net.RENDERING", TINY)
    (tmp_path / "relief").mkdir()
    with pytest.raises(SystemExit, match="expected meshes"):
        run(f"train_light_net draw {tmp_path}/drawn {tmp_path} {tmp_path}/relief")
    write_shapes(tmp_path)
    command = f"train_light_net draw {tmp_path}/drawn {tmp_path} {tmp_path}/relief --seed 4"
    kinds = [line.split()[-1] for line in run(f"{command} --scenes 4").splitlines()]
    assert len(set(kinds)) == 4 and {"smooth", "view"} < set(kinds)
    assert len(run(f"{command} --scenes 5").splitlines()) == 1


@pytest.mark.usefixtures("coarse_shapes")
def test_train_material_net(run, tmp_path, monkeypatch):
    """The largest observation of a matte pixel is about that of a surface facing the light, in
    generated captures and in those of a set, whose materials are drawn again.
    """
    for module in ("train_light_net", "train_material_net"):
        monkeypatch.setattr(f"{module}.RENDERING", TINY)
    small = {"BATCHES": 8, "CAPTURES": 2, "SPHERES": 1, "NARROW": 1, "OF_A_SET": 2}
    for name, value in small.items():
        monkeypatch.setattr(f"train_material_net.{name}", value)
    write_shapes(tmp_path)
    shapes = f"{tmp_path} {tmp_path}/relief"
    run(f"train_light_net draw {tmp_path}/set {shapes} --scenes 4")
    shards = tmp_path / "shards"
    paths = run(f"train_material_net draw {shards} {shapes} {tmp_path}/set").split()
    assert len(paths) == 4
    for path in (paths[0], paths[2]):
        roughness, metallic, log_base, *_ = load_file(path)["targets"].reshape(-1, 6).T
        matte = log_base[(metallic == 0) & (roughness > 0.6)]
        assert len(matte) > 100 and abs(np.median(matte)) < 0.2 and matte.std() < 0.8
    assert run(f"train_material_net train {shards} --steps 500").startswith("500 roughness 0.")
    network = MaterialNet()
    load_module(network, shards / "material-net", MATERIAL_FORMAT)
    from train_material_net import read, validate

    held = sorted(shards.glob("*.safetensors"))
    below_median = validate(network.float().eval(), read([held[0], held[-1]]))[-1]
    assert below_median == approx(0.5, abs=0.05)


def test_train_judge_net(run, tmp_path, coarse_shapes, monkeypatch, rng):
    """A network learns classes that one feature tells apart, and its probabilities follow."""
    drawn = tmp_path / "drawn.npz"
    run(f"train_judge_net draw {drawn} --scenes 1")
    with np.load(drawn) as stored:
        n_features = stored["features"].shape[1]
        assert np.abs(stored["features"]).max() <= 15
        assert set(stored["classes"]) <= set(range(len(CLASSES)))
    classes = rng.integers(0, len(CLASSES), 600)
    features = rng.normal(0, 0.1, (600, n_features))
    features[np.arange(600), classes] += 1
    columns = {"classes": classes, "scenes": np.arange(600), "materials": np.full(600, "ideal")}
    np.savez(tmp_path / "made.npz", features=features, **columns)
    monkeypatch.setattr("train_judge_net.STEPS", 400)
    printed = run(f"train_judge_net train {tmp_path}/made.npz -o {tmp_path}/net.safetensors")
    assert "0.50 ideal        right, doubted   0.0 %" in printed
    assert all(f"0.30 {name:12} named 100.0 %" in printed for name in CLASSES[2:])
    net = JudgeNet(**load_file(tmp_path / "net.safetensors"))
    assert (net.probabilities(features).argmax(axis=1) == classes).all()
