"""`splinecli evaluate` on analytic captures: files, tables, and what goes wrong."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest


@pytest.fixture
def dataset(make_capture):
    """Two captures; on `shaded` light 1 is shadowed out, so that LS is wrong wherever it is drawn."""
    make_capture("data/matte")
    shaded = make_capture("data/shaded")
    cv2.imwrite(str(shaded / "image1.png"), np.zeros((24, 24), np.uint16))
    return Path("data")


def test_files_and_table(dataset, run, golden):
    result = run("evaluate", dataset, "--method", "ls", "--n-lights", 4, "--trials", 3, "--seed", 0)
    assert (result.code, result.err) == (0, "")
    golden("evaluate_table.txt", result.out)
    golden("evaluate_results.json", Path("evaluation/results.json").read_text())
    golden("evaluate_table.md", Path("evaluation/table.md").read_text())
    with Path("evaluation/results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["capture"], row["trials"]) for row in rows] == [
        ("ls", "matte", "3"),
        ("ls", "shaded", "3"),
    ]
    document = json.loads(Path("evaluation/results.json").read_text())
    matte, shaded = document["results"]
    assert matte["mae_deg"] < 1e-3 < shaded["mae_deg"]
    assert document["averages"]["ls"] == pytest.approx((matte["mae_deg"] + shaded["mae_deg"]) / 2, abs=1e-4)


def test_the_draw_of_infer_is_the_first_of_evaluate(dataset, run):
    report = json.loads(
        run("infer", dataset / "shaded", "--method", "ls", "--n-lights", 5, "--seed", 3, "--json").out
    )
    document = json.loads(
        run(
            "evaluate",
            dataset / "shaded",
            "--method",
            "ls",
            "--n-lights",
            5,
            "--seed",
            3,
            "--trials",
            1,
            "--json",
        ).out
    )
    assert document["results"][0]["mae_deg"] == pytest.approx(report["angular_error_deg"]["mean"], abs=1e-4)


def test_draws_from_a_file(dataset, run):
    Path("draws.txt").write_text("# without the shadowed light\n1 2 3 4\n4,5,6,7\n")
    document = json.loads(run("evaluate", dataset, "--method", "ls", "--draws", "draws.txt", "--json").out)
    assert document["protocol"]["draws"] == "draws.txt"
    assert [(r["trials"], r["n_lights"]) for r in document["results"]] == [(2, 4), (2, 4)]
    assert all(result["mae_deg"] < 1e-3 for result in document["results"])


def test_several_light_counts_and_all(dataset, run, golden):
    arguments = ["--n-lights", 4, "--n-lights", "all", "--trials", 2, "--max-pixels", 50]
    result = run("evaluate", dataset, "--method", "ls", *arguments)
    assert result.code == 0
    golden("evaluate_several.txt", result.out)


def test_a_capture_without_ground_truth_is_passed_over(dataset, run, golden):
    (dataset / "matte/normals_gt.npy").unlink()
    result = run("evaluate", dataset, "--method", "ls", "--n-lights", 4, "--trials", 1, "--json")
    assert result.code == 3
    golden("evaluate_skipped.txt", result.err)
    assert [entry["capture"] for entry in json.loads(result.out)["skipped"]] == ["matte"]


def test_refusals(dataset, run, golden):
    messages = []
    for code, arguments in (
        (3, ["nowhere"]),
        (2, [dataset, "--n-lights", "few"]),
        (2, [dataset, "--n-lights", 2]),
        (2, [dataset, "--method", "magic"]),
        (2, [dataset, "--trials", 0]),
        (2, [dataset, "--n-lights", 4, "--draws", "draws.txt"]),
        (3, [dataset, "--draws", "draws.txt"]),
        (2, [dataset, "--method", "ls", "--n-lights", 9]),
    ):
        result = run("evaluate", *arguments)
        assert (result.code, result.out) == (code, ""), arguments
        messages.append(result.err)
    golden("evaluate_refusals.txt", "".join(messages))
    assert not Path("evaluation").exists()


def test_a_wide_table_is_turned_and_never_cut(make_capture, run, golden):
    for index in range(9):
        make_capture(f"data/capture_number_{index}[red]")
    result = run("evaluate", "data", "--method", "ls", "--n-lights", "all")
    golden("evaluate_wide.txt", result.out)
    assert "capture_number_8[red]" in result.out
