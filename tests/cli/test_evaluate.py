"""`splinecli evaluate` on analytic captures: files, tables, and what goes wrong."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from scenes import names_in, parametrize, read_json, to_uint16, write_capture, write_image
from splinecli.maths.normals import unit


@pytest.fixture
def dataset(make_capture):
    """Two captures; on `shaded` light 1 is shadowed out, so that LS is wrong wherever it is
    drawn.
    """
    make_capture("data/matte")
    write_image(make_capture("data/shaded") / "image1.png", np.zeros((24, 24), np.uint16))
    return Path("data")


def test_files_and_table(dataset, run, golden):
    result = run(f"evaluate {dataset} --method ls --n-lights 4 --trials 3 --seed 0", err="")
    golden("evaluate_table.txt", result.out)
    golden("evaluate_results.json", Path("evaluation/results.json").read_text())
    golden("evaluate_table.md", Path("evaluation/table.md").read_text())
    with Path("evaluation/results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = [(row["method"], row["capture"], row["trials"]) for row in rows]
    assert found == [("ls", "matte", "3"), ("ls", "shaded", "3")]
    matte, shaded = read_json("evaluation/results.json")["results"]
    assert matte["mae_deg"] < 1e-3 < shaded["mae_deg"]


@pytest.fixture
def overexposed(make_capture):
    """A capture whose lights are unequally bright, which no file says, and whose brightest
    observations are clipped.
    """
    folder = make_capture("overexposed")
    y, x = np.mgrid[0.8:-0.8:24j, -0.8:0.8:24j]
    normals = unit(np.stack((x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0.1))), axis=2))
    intensities = np.array((1.0, 0.8, 1.2, 0.7, 1.3, 0.9, 1.1, 1.0))
    images = (
        np.clip(0.9 * intensities * (normals @ np.loadtxt(folder / "light_directions.txt").T), 0, 1)
        * 65535
    )
    pictures = to_uint16(np.moveaxis(images, 2, 0))
    return write_capture(
        folder, pictures, None, normals=np.float32(normals), names="image{}.png", first=1
    )


@parametrize(
    "method, lights",
    """
iw12 |
ls | --n-lights 7 --seed 3
""",
)
def test_infer_and_evaluate_give_the_same_figure(overexposed, document, method, lights):
    """The draw of `infer` is the first of `evaluate`."""
    figures = []
    for policy, reading in (("", "restored"), ("--as-stored", "as stored")):
        shared = f"{overexposed} --method {method} {policy} --overwrite"
        report = document(f"infer {shared} {lights}")
        evaluation = document(f"evaluate --trials 1 {shared} {lights or '--n-lights all'}")
        (result,) = evaluation["results"]
        assert result["mae_deg"] == pytest.approx(report["angular_error_deg"]["mean"], abs=1e-4)
        assert evaluation["protocol"]["as_stored"] == bool(policy)
        assert report["reading"] == reading
        figures.append(result["mae_deg"])
    restored, as_stored = figures
    assert restored < as_stored / 2


def test_a_capture_without_ground_truth_is_skipped(dataset, run, golden):
    (dataset / "matte/normals_gt.npy").unlink()
    result = run(f"evaluate {dataset} --method ls --n-lights 4 --trials 1 --json", code=3)
    golden("evaluate_skipped.txt", result.err)
    assert [entry["capture"] for entry in result.json["skipped"]] == ["matte"]


def test_refusals(refuse, dataset):
    cases = f"""
        3 nowhere
        2 {dataset} --n-lights few
        2 {dataset} --n-lights 2
        2 {dataset} --method magic
        2 {dataset} --trials 0
        2 {dataset} --n-lights 4 --draws draws.txt
        3 {dataset} --draws draws.txt
        2 {dataset} --method ls --n-lights 9
        2 {dataset} --method ls --skip-first shaded
        2 {dataset} --method ls --skip-first =3
        2 {dataset} --method ls --n-lights 4 --skip-first cow=3
        2 {dataset} --method ls --n-lights all --skip-first 6
        2 {dataset} --method ls --n-lights 4 --skip-first 20
        2 {dataset} --draws draws.txt --trials 3
        2 {dataset} --pixel 3,4
        2 {dataset} --method ls --pixel 3,4 --figures
        2 {dataset} --pixel=-1,4 --figures
        2 {dataset} --method ls --pixel 3 --figures
        2 {dataset} --jobs 0
        4 {dataset} --method cnn-ps --weights spline-net --n-lights 4
    """
    refuse("evaluate", cases)
    assert not Path("evaluation").exists()


def test_a_wide_table_is_turned_and_never_cut(make_capture, run, golden):
    for index in range(9):
        make_capture(f"data/capture_number_{index}[red]")
    result = run("evaluate data --method ls --n-lights all")
    golden("evaluate_wide.txt", result.out)
    assert "capture_number_8[red]" in result.out
    methods = (
        "--method ls --method ls-trimmed --method l1 --method iw12 --method st14 --method ia14"
    )
    wide = run(f"evaluate data --n-lights all {methods}").out
    assert "ls-trimmed" in wide
    assert "capture_number_8[red]" in wide
    assert "…" not in wide


FILES = [
    "lights.png",
    "report.html",
    "results.csv",
    "results.json",
    "table.md",
    "table.tex",
    "trials.jsonl",
]


def test_every_file_is_there_and_goes_on(dataset, run):
    arguments = f"evaluate {dataset} --method ls --method iw12 --n-lights 4 --n-lights 5"
    first = run(f"{arguments} --trials 2 --json")
    assert first.code == 0
    assert (
        sorted(path.name for path in Path("evaluation").iterdir() if path.name != ".lock") == FILES
    )
    assert "iw12" in Path("evaluation/report.html").read_text()
    kept = Path("evaluation/trials.jsonl").read_text()
    assert len(kept.splitlines()) == 2 * 2 * 2 * 2
    more = run(f"{arguments} --trials 3 --json").json
    assert Path("evaluation/trials.jsonl").read_text().startswith(kept)
    assert len(Path("evaluation/trials.jsonl").read_text().splitlines()) == 2 * 2 * 2 * 3
    for before, after in zip(first.json["results"], more["results"], strict=True):
        assert after["maes_deg"][:2] == before["maes_deg"]
    # Fewer light counts make no plot, and leave none behind.
    assert run(f"{arguments.removesuffix(' --n-lights 5')} --trials 3").code == 0
    assert not Path("evaluation/lights.png").exists()
    assert run(f"{arguments} --trials 3 --overwrite --jobs 1").code == 0
    assert len(Path("evaluation/trials.jsonl").read_text().splitlines()) == 2 * 2 * 2 * 3


def test_figures(dataset, run):
    arguments = "--n-lights 4 --trials 1 --max-pixels 30 --figures --pixel 9,10 --pixel 12,5"
    methods = "--method ls --method spline-net-pixelwise --method spline-net"
    run(f"evaluate {dataset} {methods} {arguments}")
    # The two networks are one: it has one figure of observation maps.
    names = [
        f"{name}{suffix}.png"
        for name in ("matte", "shaded")
        for suffix in ("", "_observation_maps")
    ]
    assert names_in("evaluation/figures") == set(names)
    maps = cv2.imread("evaluation/figures/shaded.png")
    assert maps.shape[1] > maps.shape[0]
    assert Path("evaluation/report.html").read_text().count("data:image/png") == 4
    # The results are there although no figure can be drawn, and earlier figures are gone.
    run(
        f"evaluate {dataset} --method spline-net {arguments.replace('12,5', '0,0')}",
        input_error="no figure: the pixel in row 0, column 0 of matte has no ground truth",
    )
    assert "spline-net" in Path("evaluation/table.md").read_text()
    assert not list(Path("evaluation/figures").iterdir())


def test_all_methods_by_one_word(dataset, run):
    from splinecli.estimate.methods import method_names

    options = "--method all --n-lights all --max-pixels 9 --json"
    result = run(f"evaluate {dataset / 'matte'} {options}")
    document = result.json
    assert [scored["method"] for scored in document["results"]] == method_names()
    assert (
        result.err == "splinecli: warning: The weights cnn-ps were trained with 10 lights, not 8.\n"
    )
    assert document["methods"]["cnn-ps"]["weights"]["name"] == "cnn-ps"
    assert "cnn-ps (SHA-256" in Path("evaluation/report.html").read_text()


def test_the_white_level_is_used_and_named(overexposed, document):
    """A level below the image values makes the values above it saturated, so they are restored."""
    arguments = f"evaluate {overexposed} --method ls --n-lights all"
    plain, lower = document(arguments), document(f"{arguments} --white-level 50000")
    assert plain["protocol"]["white_level"] is None
    assert lower["protocol"]["white_level"] == 50_000
    assert lower["results"][0]["mae_deg"] != plain["results"][0]["mae_deg"]
    assert "white level 50000, images restored" in Path("evaluation/table.md").read_text()
