"""The whole text of every document of an evaluation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from splinecli import __version__
from splinecli.evaluation.records import Evaluation, Protocol, Result, Skipped
from splinecli.evaluation.tables import best_cells, markdown, results_csv, results_document, table_rows

TEN = Evaluation(
    Protocol(n_lights=10, trials=2, seed=7, max_pixels=500),
    (
        Result("ls", "ball", 10, (4.0, 5.0), 0.00125),
        Result("spline-net", "ball", 10, (3.25, 3.25), 1.5),
        Result("ls", "cat", 10, (9.001, 9.003), 0.001),
        Result("spline-net", "cat", 10, (9.004, 9.004), 1.25),
    ),
    (Skipped("bear", "bear: no images."),),
)
ALL = Evaluation(
    replace(TEN.protocol, n_lights=None),
    (
        Result("ls", "ball", 96, (4.0,), 0.01),
        Result("spline-net", "ball", 96, (4.5,), 2.0),
        Result("ls", "cat", 50, (8.5,), 0.01),
        Result("spline-net", "cat", 50, (6.0,), 2.0),
    ),
    TEN.skipped,
)

TABLE = """\
| method | ball | cat | average |
|---|---:|---:|---:|
| ls | 4.50 | **9.00** | 6.75 |
| spline-net | **3.25** | **9.00** | **6.13** |
"""


def test_markdown_of_one() -> None:
    assert markdown([TEN]) == TABLE


def test_markdown_of_two() -> None:
    assert markdown([TEN, ALL]) == (
        f"## 10 lights\n\n{TABLE}"
        "\n## all lights\n\n"
        "| method | ball | cat | average |\n"
        "|---|---:|---:|---:|\n"
        "| ls | **4.00** | 8.50 | 6.25 |\n"
        "| spline-net | 4.50 | **6.00** | **5.25** |\n"
    )


def test_one_method_has_no_best() -> None:
    alone = replace(TEN, results=TEN.results[:1])
    assert markdown([alone]) == "| method | ball | average |\n|---|---:|---:|\n| ls | 4.50 | 4.50 |\n"


def test_a_bar_in_a_name_does_not_end_the_cell() -> None:
    odd = replace(TEN, results=(replace(TEN.results[0], capture="a|b"),))
    assert markdown([odd]).startswith("| method | a\\|b | average |\n")


def test_rows_for_a_terminal() -> None:
    rows = table_rows(TEN)
    assert rows == [
        ["method", "ball", "cat", "average"],
        ["ls", "4.50", "9.00", "6.75"],
        ["spline-net", "3.25", "9.00", "6.13"],
    ]
    assert best_cells(rows) == {(2, 1), (1, 2), (2, 2), (2, 3)}


def test_csv() -> None:
    assert results_csv([TEN, ALL]) == (
        "method,capture,n_lights,light_noise_deg,mae_deg,std_deg,trials,seconds\n"
        "ls,ball,10,0.0,4.5,0.5,2,0.0013\n"
        "spline-net,ball,10,0.0,3.25,0.0,2,1.5\n"
        "ls,cat,10,0.0,9.002,0.001,2,0.001\n"
        "spline-net,cat,10,0.0,9.004,0.0,2,1.25\n"
        "ls,ball,96,0.0,4.0,0.0,1,0.01\n"
        "spline-net,ball,96,0.0,4.5,0.0,1,2.0\n"
        "ls,cat,50,0.0,8.5,0.0,1,0.01\n"
        "spline-net,cat,50,0.0,6.0,0.0,1,2.0\n"
    )


def test_json_of_one() -> None:
    one = replace(TEN, results=TEN.results[:2])
    assert json.dumps(results_document([one]), indent=1) == JSON.replace("VERSION", __version__)


JSON = """\
{
 "protocol": {
  "n_lights": 10,
  "trials": 2,
  "seed": 7,
  "draws": null,
  "light_noise_deg": 0.0,
  "max_pixels": 500
 },
 "results": [
  {
   "method": "ls",
   "capture": "ball",
   "n_lights": 10,
   "light_noise_deg": 0.0,
   "mae_deg": 4.5,
   "std_deg": 0.5,
   "trials": 2,
   "seconds": 0.0013
  },
  {
   "method": "spline-net",
   "capture": "ball",
   "n_lights": 10,
   "light_noise_deg": 0.0,
   "mae_deg": 3.25,
   "std_deg": 0.0,
   "trials": 2,
   "seconds": 1.5
  }
 ],
 "averages": {
  "ls": 4.5,
  "spline-net": 3.25
 },
 "skipped": [
  {
   "capture": "bear",
   "reason": "bear: no images."
  }
 ],
 "version": "VERSION"
}"""


def test_json_of_two() -> None:
    document = results_document([TEN, ALL])
    assert document["protocol"]["n_lights"] == [10, "all"]
    assert document["averages"] == {
        "ls": {"10": 6.751, "all": 6.25},
        "spline-net": {"10": 6.127, "all": 5.25},
    }
    assert [record["n_lights"] for record in document["results"]] == [10, 10, 10, 10, 96, 96, 50, 50]
    assert document["skipped"] == [{"capture": "bear", "reason": "bear: no images."}]  # once


def test_light_noise_tells_evaluations_apart() -> None:
    noisy = replace(TEN, protocol=replace(TEN.protocol, light_noise_deg=2.5))
    document = results_document([TEN, noisy])
    assert document["protocol"]["n_lights"] == 10
    assert document["protocol"]["light_noise_deg"] == [0.0, 2.5]
    assert list(document["averages"]["ls"]) == ["0", "2.5"]
    assert list(results_document([TEN, ALL, noisy])["averages"]["ls"]) == ["10, 0", "all, 0", "10, 2.5"]
    assert "## 10 lights, light noise of 2.5 degrees\n" in markdown([TEN, noisy])


def test_the_draws_file_is_named() -> None:
    drawn = replace(TEN, protocol=replace(TEN.protocol, draws_file=Path("some/where/draws.txt")))
    assert results_document([drawn])["protocol"]["draws"] == "draws.txt"
