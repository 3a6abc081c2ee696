"""`splinecli train`: a short run, its files, continuation, and refusals."""

import csv
import os
import sys
from pathlib import Path

import pytest

from kills import content
from scenes import names_in, parametrize, put, read_json
from small_pixel_sets import matte_pixels
from splinecli.system.files import UNFINISHED
from splinecli.system.publishing import UNDONE
from splinecli.workshop.training.run_files import RunLog


@pytest.fixture(autouse=True)
def small_runs(monkeypatch):
    """Tiny networks and few validation pixels: these tests are about the command, not about
    learning.
    """
    from splinecli.estimate.networks.config import NetworkConfig
    from splinecli.workshop.training import config, tasks

    tiny = config.TrainingConfig(
        network=NetworkConfig(width=8, li_blocks=1, ne_blocks=1, head_width=8), batch_size=16
    )
    monkeypatch.setitem(config.PRESETS, "compact", tiny)
    monkeypatch.setattr(tasks, "VALIDATION_PIXELS", 32)


def steps():
    with Path("run/metrics.csv").open(encoding="utf-8", newline="") as file:
        return [row["step"] for row in csv.DictReader(file)]


SAVED = {"weights.safetensors", "checkpoint.safetensors", "config.json", "metrics.csv"}


def settings():
    return read_json("run/config.json")


def write_set(folder, *, finished=True):
    """Matte pixels in three scenes under 14 lights."""
    from splinecli.workshop.pixel_sets.store import PixelSetWriter

    writer = PixelSetWriter(Path(folder))
    for seed, scene in enumerate("abc"):
        writer.add(scene, scene, "a test", {"by": "hand"}, matte_pixels(50, 14, seed=seed))
    if finished:
        writer.finish()


def test_a_run_and_its_continuation(run, monkeypatch):
    result = run(
        "train -o run --steps 3", says="step 3, 0.0 minutes: loss", out="run/weights.safetensors\n"
    )
    assert names_in("run") == SAVED | {"curves.png", "maps.png"}
    assert settings()["steps"] == 3
    assert settings()["sources"] == {"generator": 1.0}
    assert steps() == ["3"]
    monkeypatch.setattr(RunLog, "draw", lambda self, maps: None)
    assert run("train -o run --resume --steps 5 --quiet") == type(result)(0, "", "")
    assert steps() == ["3", "5"]
    # A name that is not UTF-8, which the library of the weights does not take.
    other = os.fsdecode(b"r\xffn")
    try:
        Path("run").rename(other)
    except OSError:
        pytest.skip("the file system has no such names")
    run(f"train -o {other} --resume --steps 5 --quiet")
    Path(other).rename("run")
    # Settings may be repeated if they are those of the run.
    again = "--resume --steps 6 --preset compact --seed 0 --quiet"
    run(f"train -o run {again}")
    assert steps() == ["3", "5", "6"]


def test_a_run_on_pixel_sets(run, document, no_pictures, make_capture):
    write_set("set")
    write_set("more/set")
    run("train set more/set -o run --n-lights 4-8 --steps 4 --seed 5")
    assert names_in("run") == SAVED
    values = settings()
    # A run continues from another working folder.
    assert values["sources"] == {f"{Path.cwd()}/{name}": 1.0 for name in ("set", "more/set")}
    lights = [values["pixels"][name] for name in ("min_lights", "max_lights", "usual_lights")]
    assert lights == [4, 8, 8]
    assert values["seed"] == 5
    report = document(f"infer {make_capture('sphere')} --weights run/weights.safetensors")
    assert report["angular_error_deg"]["mean"] < 10
    # First from the same folder, then from another.
    run("train -o run --resume --steps 5 --quiet")
    Path("elsewhere").mkdir()
    os.chdir("elsewhere")
    run("train -o ../run --resume --steps 6 --quiet")


def test_settings_come_from_preset_file_and_options(run, no_pictures):
    put("a.toml", "seed = 4\nbatch_size = 8\n[pixels]\nwall_share = 0.25\nmax_lights = 20\n")
    options = "--param batch_size=4 --param pixels.ambient_share=0 --n-lights 12 --steps 1"
    run(f"train -o run --config a.toml {options} --quiet")
    values = settings()
    top = {"seed": 4, "batch_size": 4, "steps": 1}
    assert values | top == values
    pixels = {"wall_share": 0.25, "ambient_share": 0, "min_lights": 12, "max_lights": 12}
    assert values["pixels"] | pixels == values["pixels"]
    # The configuration of one run starts another.
    run("train -o other --config run/config.json --seed 9 --quiet")
    assert read_json("other/config.json") == values | {"seed": 9}


def test_tensorboard_is_an_extra(run, no_pictures, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
    says = "--tensorboard needs the package tensorboard", "Run pip install 'splinecli[tensorboard]'"
    run("train -o run --steps 1 --tensorboard", usage_error=says, out="")


def test_processes_that_cannot_share_a_batch(run, monkeypatch):
    from splinecli.workshop.training import loop as training_run

    monkeypatch.setattr(
        training_run, "join_workers", lambda device: (training_run.Workers(0, 3), device)
    )
    run("train -o run --steps 1", usage_error="3 processes cannot share the 4 shards", out="")
    assert not Path("run").exists()


def test_a_restarted_worker_continues_by_itself(run, no_pictures, monkeypatch):
    run("train -o run --steps 3 --quiet")
    monkeypatch.setattr("splinecli.workshop.training.loop.restarts_are_allowed", lambda: True)
    run("train -o run --steps 5 --quiet")
    assert steps() == ["3", "5"]
    # Without a checkpoint, a run starts.
    run("train -o other --steps 1 --quiet")


def test_resuming_a_finished_run_says_so(run, no_pictures):
    run("train -o run --steps 1")
    before = content(Path("run"))
    Path("run", f".weights.safetensors.x{UNFINISHED}").touch()  # a killed process was writing this
    result = run("train -o run --resume --steps 1", out="run/weights.safetensors\n")
    warning, message = result.err.splitlines()
    assert warning == f"splinecli: warning: run: {UNDONE}"
    assert message.startswith("run: the run is already complete.")
    assert content(Path("run")) == before


@parametrize("damage", [b"\xff\xfe\x00", b"step,pixels\n1,2\n3,4\n", b"\x00" * 50 + b"\n1,2\n"])
def test_a_damaged_log_is_kept_aside(run, no_pictures, damage):
    run("train -o run --steps 1 -q")
    damaged = Path("run/metrics.csv").read_bytes() + damage
    Path("run/metrics.csv").write_bytes(damaged)
    says = "warning: metrics.csv was damaged and has been renamed to run/metrics.damaged.csv"
    run("train -o run --resume --steps 2", says=says)
    assert Path("run/metrics.damaged.csv").read_bytes() == damaged
    assert steps() == ["2"]


def test_refusals(run, refuse, no_pictures):
    run("train -o run --steps 1")
    put("unknown.toml", "[pixels]\nlights = 5\n")
    put("broken.toml", "steps =\n")
    write_set("set")
    write_set("unfinished", finished=False)
    write_set("changed")
    normals = Path("changed/b/normals.npy")
    whole = normals.read_bytes()
    normals.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    Path("empty").mkdir()
    cases = """
        5 -o run
        4 -o other --resume
        2 -o other --preset huge
        2 -o other --steps 1 --minutes 1
        2
        # settings
        4 -o other --param sead=1
        4 -o other --param network.widht=8
        4 -o other --param updates=both
        4 -o other --param batch_size=6
        2 -o other --param seed
        4 -o other --config unknown.toml
        4 -o other --config broken.toml
        4 -o other --config none.toml
        4 -o other --generator-weight 0
        4 -o other --start-from nowhere
        4 -o other --start-from cnn-ps
        2 -o other --n-lights=few
        2 -o other --n-lights=2
        2 -o other --n-lights=9-4
        2 -o other --n-lights=4-
        2 -o other --n-lights=
        # another run's checkpoint
        4 -o run --resume --steps 2 --param network.size=paper
        4 -o run --resume --steps 2 --seed 1
        4 -o run --resume --steps 2 --n-lights 10
        # sets
        3 missing -o other
        3 empty -o other
        3 unfinished -o other
        3 set changed -o other
    """
    refuse("train", cases)
    assert not Path("other").exists()
    assert steps() == ["1"]
