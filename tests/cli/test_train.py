"""`splinecli train`: a short run, its files, going on, and its refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def small_runs(tmp_path, monkeypatch):
    """Tiny networks and few validation pixels: these tests are about the command, not about learning."""
    from splinecli.networks.config import NetworkConfig
    from splinecli.training import config, loop

    tiny = config.TrainingConfig(
        network=NetworkConfig(width=8, li_blocks=1, ne_blocks=1, head_width=8), batch_size=16
    )
    monkeypatch.setitem(config.PRESETS, "compact", tiny)
    monkeypatch.setattr(loop, "VALIDATION_PIXELS", 32)
    monkeypatch.chdir(tmp_path)


def rows() -> list[dict[str, str]]:
    with Path("run/metrics.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_and_its_continuation(run):
    result = run("train", "-o", "run", "--steps", 3)
    assert (result.code, result.out) == (0, "run/weights.safetensors\n")
    assert "step 3, 48 pixels" in result.err
    files = {path.name for path in Path("run").iterdir()}
    assert files == {"weights.safetensors", "checkpoint.safetensors", "config.json", "metrics.csv"}
    assert json.loads(Path("run/config.json").read_text())["steps"] == 3
    assert [row["step"] for row in rows()] == ["3"]
    assert run("train", "-o", "run", "--resume", "--steps", 5, "--quiet") == type(result)(0, "", "")
    assert [row["step"] for row in rows()] == ["3", "5"]


def test_the_weights_work(run, make_capture):
    run("train", "-o", "run", "--steps", 1, "--quiet")
    report = json.loads(
        run("infer", make_capture("sphere"), "--weights", "run/weights.safetensors", "--json").out
    )
    assert report["weights"]["name"] == "weights"
    assert report["angular_error_deg"]["mean"] < 5


def test_refusals(run, golden):
    run("train", "-o", "run", "--steps", 1)
    messages = []
    for code, arguments in (
        (5, ["-o", "run"]),
        (4, ["-o", "run", "--resume", "--steps", 1]),
        (4, ["-o", "other", "--resume"]),
        (2, ["-o", "other", "--preset", "huge"]),
        (2, ["-o", "other", "--steps", 1, "--minutes", 1]),
        (2, ["-o", "run", "--resume", "--preset", "paper"]),
        (2, []),
    ):
        result = run("train", *arguments)
        assert (result.code, result.out) == (code, "")
        messages.append(result.err)
    golden("train_refusals.txt", "".join(messages))
    assert not Path("other").exists()
