"""The whole text of every document of an evaluation stands in tests/golden/."""

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from splinecli.evaluation.document import html_report, results_csv, results_document
from splinecli.evaluation.protocol import Evaluation, Protocol, Result, Skipped
from splinecli.evaluation.tables import best_cells, latex, markdown, table_rows

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


def test_whole_documents(golden: Callable[[str, str], None]) -> None:
    """Of the comparisons by hand: differences 0.75 and 1.75, t = 1.25 / 0.5 = 2.5 with one degree of freedom, where t's
    distribution is Cauchy's: p = 1 - 2 atan(2.5) / pi = 0.242, and 0.5 tan(0.95 pi / 2) = 6.3531."""
    both = [TEN, ALL]
    for suffix, text in (
        ("md", markdown(both)),
        ("csv", results_csv(both)),
        ("tex", latex([TEN])),
        ("json", json.dumps(results_document(both), indent=1) + "\n"),
    ):
        golden(f"evaluation_results.{suffix}", text)


def test_rows_for_a_terminal() -> None:
    rows = table_rows(TEN)
    assert rows == [
        ["method", "ball", "cat", "average"],
        ["ls", "4.50", "9.00", "6.75"],
        ["spline-net", "3.25", "9.00", "6.13"],
    ]
    assert best_cells(rows) == {(2, 1), (1, 2), (2, 2), (2, 3)}


@pytest.mark.parametrize(
    ("name", "shown"),
    [("a|b", r"a\|b"), ("![a](javascript:alert(1)) &lt; ~~b~~", r"!\[a\](javascript:alert(1)) \&lt; \~\~b\~\~")],
)
def test_names_are_text_in_markdown(name: str, shown: str) -> None:
    odd = replace(TEN, results=(replace(TEN.results[0], capture=name),))
    assert markdown([odd]).startswith(f"| method | {shown} | average |\n")


def test_light_noise_tells_evaluations_apart() -> None:
    noisy = replace(TEN, protocol=replace(TEN.protocol, light_noise_deg=2.5))
    document = results_document([TEN, noisy])
    assert document["protocol"]["n_lights"] == 10
    assert document["protocol"]["light_noise_deg"] == [0.0, 2.5]
    assert list(document["averages"]["ls"]) == ["0", "2.5"]
    assert list(results_document([TEN, ALL, noisy])["averages"]["ls"]) == ["10, 0", "all, 0", "10, 2.5"]
    assert "## 10 lights, light noise of 2.5 degrees\n" in markdown([TEN, noisy])


@pytest.mark.parametrize("as_stored", [False, True])
def test_every_document_names_how_the_captures_were_read(as_stored: bool) -> None:
    evaluation = replace(TEN, protocol=replace(TEN.protocol, as_stored=as_stored))
    words = "images as stored." if as_stored else "images restored."
    assert words in markdown([evaluation]) and words in latex([evaluation])
    document = results_document([evaluation])
    assert document["protocol"]["as_stored"] is as_stored
    assert {record["as_stored"] for record in document["results"]} == {as_stored}
    rows = csv.DictReader(results_csv([evaluation]).splitlines())
    assert {row["as_stored"] for row in rows} == {str(as_stored)}
    shown = "as stored: nothing restored" if as_stored else "lens blur removed, saturated observations restored"
    assert shown in html_report([evaluation], [], [])


def test_latex_escapes_names() -> None:
    odd = replace(TEN.results[0], method=r"a_b&50%", capture=r"#1 $x$ {y} \z ~^ <|>")
    drawn = replace(TEN.protocol, draws_file=Path("my_draws.txt"))
    text = latex([replace(TEN, protocol=drawn, results=(odd,))])
    assert r"a\_b\&50\% & 4.50 & 4.50 \\" in text
    escaped = r"\#1 \$x\$ \{y\} \textbackslash{}z \textasciitilde{}\textasciicircum{}"
    assert rf"method & {escaped} \textless{{}}\textbar{{}}\textgreater{{}} & average \\" in text
    assert r"the 2 draws of my\_draws.txt, seed 7" in text
    assert "bold" not in text  # one method is no best
    unescaped = re.sub(r"\\[{}]", "", text)
    assert unescaped.count("{") == unescaped.count("}")
