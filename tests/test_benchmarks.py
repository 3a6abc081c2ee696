"""Each benchmark runs to its end on small inputs and prints every row."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from splinecli.methods import method_names
from splinecli.networks.config import NetworkConfig
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import save_weights

ROOT = Path(__file__).resolve().parents[1]
MEDALLION = str(ROOT / "examples/medallion")

Run = Callable[..., str]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the benchmark of this name and return what it prints."""

    def run_benchmark(name: str, *arguments: str) -> str:
        spec = importlib.util.spec_from_file_location(name, ROOT / f"benchmarks/{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        main: Callable[[Sequence[str]], None] = module.main
        main(arguments)
        return capsys.readouterr().out

    return run_benchmark


def numbers(line: str) -> list[float]:
    return [
        float(number) for number in re.findall(r"(?<![\w-])\d+(?:\.\d+)?(?![\w-])", line.replace(",", ""))
    ]


def test_every_benchmark_has_a_test() -> None:
    text = Path(__file__).read_text("utf-8")
    for path in (ROOT / "benchmarks").glob("*.py"):
        assert f'run("{path.stem}"' in text.replace("(\n        ", "("), path.name


def test_training_speed(run: Run) -> None:
    """It crashed: CNN-PS has no LI-Net, so its updates cannot alternate."""
    printed = run(
        "training_speed", "--batch-size", "8", "--steps", "1", "--warm-up", "1", "--device", "cpu"
    ).splitlines()
    rows = [line.split("  ")[0] for line in printed[1:]]
    assert rows == ["compact", "compact, Ls and La", "compact, alternating", "paper", "cnn-ps"]
    assert all(min(numbers(line[25:])) > 0 for line in printed[1:])


def test_method_speed(run: Run) -> None:
    printed = run("method_speed", MEDALLION, "--pixels", "40", "--repeats", "1").splitlines()
    assert printed[0] == "medallion, 10 lights"
    assert [line.split()[0] for line in printed[1:]] == method_names()


def test_inference_speed(run: Run) -> None:
    printed = run("inference_speed", "--pixels", "64", "--repeats", "1").splitlines()
    assert [line.split()[0] for line in printed[1:]] == ["paper", "spline-net", "spline-net"]
    assert sum("(auto)" in line for line in printed) == 1


def test_photographs(run: Run) -> None:
    printed = run("photographs", MEDALLION, "--draws", "1", "--pixels", "60")
    overexposed, intensities, confidence = printed.split("\n\n")
    assert len(numbers(overexposed.splitlines()[1])) == 4
    assert len(numbers(intensities.splitlines()[1])) == 7
    assert [line.split()[0] for line in confidence.splitlines()[1:]] == ["medallion", "all"]


def test_faulty_captures(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="needs the extra 'render'")
    printed = run("faulty_captures", str(tmp_path), "--scenes", "5", "--size", "24")
    assert int(printed.split()[0]) > 5
    rows = run("fit_capture_confidence", str(tmp_path)).splitlines()
    assert rows[0].startswith("| capture | number | claimed before")
    assert "right" in rows[2] + rows[-1] + rows[-2]
    assert all(len(numbers(row)) == 8 for row in rows[2:])


def test_render_accuracy(run: Run) -> None:
    pytest.importorskip("mitsuba", reason="compares with Mitsuba 3")
    pytest.importorskip("embreex", reason="needs the extra 'render'")
    printed = run(
        "render_accuracy", "--size", "12", "--samples", "4", "--scenes", "1", "--directions", "4"
    ).splitlines()
    assert [line.split()[0] for line in printed[2:5]] == ["diffuse", "specular", "metallic"]
    assert printed[-1].count("%") == 3


def test_near_lamps(run: Run) -> None:
    pytest.importorskip("embreex", reason="needs the extra 'render'")
    printed = run(
        "near_lamps", "--size", "16", "--method", "ls", "--widths", "4", "--off", "0.8"
    ).splitlines()
    assert len(printed) == 8
    plane = next(row for row in printed if row.split()[:2] == ["matte", "plane"])
    distant, distant_range, as_distant, bowl, near, near_range, *_ = numbers(plane)
    assert as_distant > 5 > 1 > near
    assert bowl > 5 > 1 > near_range
    assert distant < 1 > distant_range


def test_large_captures(run: Run, tmp_path: Path) -> None:
    plot = tmp_path / "plot.png"
    arguments = ("--megapixels", "0.001", "--method", "ls", "--plot", str(plot))
    header, row = run("large_captures", *arguments).splitlines()
    assert header.split()[0] == "megapixels"
    assert numbers(row)[0] == pytest.approx(0.001, abs=2e-4)
    assert row.endswith("exact")
    assert plot.stat().st_size > 1000


def test_busy_machine(run: Run) -> None:
    """The quiet machine alone: each figure takes a process that loads PyTorch."""
    header, row = run("busy_machine", "--busy", "0", "--pixels", "100", "--repeats", "1").splitlines()
    assert header.split("  ")[-1].strip() == "default / passive"
    assert row.startswith("quiet")
    default, passive, single, ratio = numbers(row)
    assert min(default, passive, single) > 0
    half = 0.0051  # of the last digit that is printed
    assert (default - half) / (passive + half) - half <= ratio <= (default + half) / (passive - half) + half


def test_diligent_figures(run: Run, tmp_path: Path) -> None:
    """The mean is that of the trials; figures of both files are stored once."""
    entry = {"method": "ls", "capture": "ball", "n_lights": 10, "light_noise_deg": 0.0, "trials": 2}
    entry |= {"mae_deg": 2.5, "std_deg": 0.5, "maes_deg": [2.0, 3.0]}
    documents = [[entry, {**entry, "n_lights": 96}], [entry, {**entry, "light_noise_deg": 4.0}]]
    for name, results in zip(("lights.json", "noise.json"), documents, strict=True):
        (tmp_path / name).write_text(json.dumps({"protocol": {"seed": 0}, "results": results}))
    stored = tmp_path / "figures.json"
    printed = run(
        "diligent_figures",
        str(tmp_path / "lights.json"),
        str(tmp_path / "noise.json"),
        "--output",
        str(stored),
    )
    assert "| n_lights | 10 | 96 |" in printed
    assert "| light_noise_deg | 0.0 | 4.0 |" in printed
    assert printed.count("| ball, `ls` | 2.50 | 2.50 |") == 2
    assert len(json.loads(stored.read_text())["results"]) == 3


def test_wrong_lights(run: Run) -> None:
    rows = run("wrong_lights", MEDALLION, "--scenes", "0", "--draws", "1").splitlines()
    cells = dict(row.strip("| ").split(" | ") for row in rows if row.count("|") == 3 and "---" not in row)
    assert cells.pop("light file") == "medallion"
    assert cells.pop("right") == "0 of 1"
    assert len(cells) == 9
    assert sum(cell == "1 / 1 of 1" for cell in cells.values()) >= 8


def test_measured_spheres(run: Run, shared_data: Path, tmp_path: Path) -> None:
    """Trained weights are better on measured materials than a network without training, which is a Lambertian fit."""
    lights = shared_data / "DiLiGenT/pmsData/ballPNG/light_directions.txt"
    materials = shared_data / "merl_nbrdf/merl_nbrdf.npz"
    untrained = tmp_path / "untrained.safetensors"
    save_weights(SplineNet(NetworkConfig()), untrained)
    weights = "--weights", "spline-net", "--weights", str(untrained)
    printed = run(
        "measured_spheres", str(materials), str(lights), *weights, "--draws", "1", "--pixels", "4"
    ).splitlines()
    trained, fit = (float(re.findall(r": (\S+) degrees", line)[0]) for line in printed)
    assert trained < 0.7 * fit
