"""The whole text of every document of an evaluation."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from splinecli import __version__
from splinecli.evaluation.document import results_csv, results_document
from splinecli.evaluation.outcome import Evaluation, Result, Skipped
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.report import html_report
from splinecli.evaluation.tables import best_cells, latex, markdown, table_rows

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
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
PROTOCOL = "10 lights, 2 random draws, seed 7, at most 500 pixels of each capture, images restored"
CAPTION = f"Mean angular error in degrees: {PROTOCOL}.\n"


def test_markdown_of_one() -> None:
    assert markdown([TEN]) == f"{TABLE}\n{CAPTION}"


def test_markdown_of_two() -> None:
    assert markdown([TEN, ALL]) == (
        f"## 10 lights\n\n{TABLE}\n{CAPTION}"
        "\n## all lights\n\n"
        "| method | ball | cat | average |\n"
        "|---|---:|---:|---:|\n"
        "| ls | **4.00** | 8.50 | 6.25 |\n"
        "| spline-net | 4.50 | **6.00** | **5.25** |\n"
        "\nMean angular error in degrees: all lights, seed 7, at most 500 pixels of each capture,"
        " images restored.\n"
    )


def test_a_bar_in_a_name_does_not_end_the_cell() -> None:
    odd = replace(TEN, results=(replace(TEN.results[0], capture="a|b"),))
    assert markdown([odd]).startswith("| method | a\\|b | average |\n")


def test_a_link_in_a_name_is_no_link() -> None:
    name = "![a](javascript:alert(1)) &lt; ~~b~~"
    odd = replace(TEN, results=(replace(TEN.results[0], capture=name),))
    shown = r"!\[a\](javascript:alert(1)) \&lt; \~\~b\~\~"
    assert markdown([odd]).startswith(f"| method | {shown} | average |\n")


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
        "method,capture,n_lights,light_noise_deg,mae_deg,std_deg,trials,seconds,as_stored\n"
        "ls,ball,10,0.0,4.5,0.5,2,0.0013,False\n"
        "spline-net,ball,10,0.0,3.25,0.0,2,1.5,False\n"
        "ls,cat,10,0.0,9.002,0.001,2,0.001,False\n"
        "spline-net,cat,10,0.0,9.004,0.0,2,1.25,False\n"
        "ls,ball,96,0.0,4.0,0.0,1,0.01,False\n"
        "spline-net,ball,96,0.0,4.5,0.0,1,2.0,False\n"
        "ls,cat,50,0.0,8.5,0.0,1,0.01,False\n"
        "spline-net,cat,50,0.0,6.0,0.0,1,2.0,False\n"
    )


def test_json_of_one() -> None:
    # The comparison by hand: differences 0.75 and 1.75, t = 1.25 / 0.5 = 2.5 with one degree of freedom, where t's
    # distribution is Cauchy's: p = 1 - 2 atan(2.5) / pi = 0.242, and 0.5 tan(0.95 pi / 2) = 6.3531.
    one = replace(TEN, results=TEN.results[:2])
    expected = (GOLDEN / "evaluation_results.json").read_text("utf-8")
    assert json.dumps(results_document([one]), indent=1) + "\n" == expected.replace("VERSION", __version__)


def test_json_of_two() -> None:
    document = results_document([TEN, ALL])
    assert document["protocol"]["n_lights"] == [10, "all"]
    assert document["averages"] == {
        "ls": {"10": 6.751, "all": 6.25},
        "spline-net": {"10": 6.127, "all": 5.25},
    }
    assert [record["n_lights"] for record in document["results"]] == [10, 10, 10, 10, 96, 96, 50, 50]
    assert document["skipped"] == [{"capture": "bear", "reason": "bear: no images."}]  # once
    comparisons = [(c["capture"], c["n_lights"], c["differs"]) for c in document["comparisons"]]
    assert comparisons == [
        ("ball", 10, False),
        ("cat", 10, False),
        ("average", 10, False),
        ("ball", "all", None),
        ("cat", "all", None),
        ("average", "all", None),
    ]


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
    assert words in markdown([evaluation])
    assert words in latex([evaluation])
    document = results_document([evaluation])
    assert document["protocol"]["as_stored"] is as_stored
    assert {record["as_stored"] for record in document["results"]} == {as_stored}
    assert all(line.endswith(f",{as_stored}") for line in results_csv([evaluation]).splitlines()[1:])
    shown = "as stored: nothing restored" if as_stored else "saturated observations restored"
    assert shown in html_report([evaluation], [], [])


def test_latex_of_one() -> None:
    assert latex([TEN]) == LATEX.replace("PROTOCOL", PROTOCOL)


LATEX = r"""% Needs \usepackage{booktabs} in the preamble.
\begin{table*}
  \centering
  \caption{Mean angular error in degrees: PROTOCOL. The best of each column in bold.}
  \begin{tabular}{lrrr}
    \toprule
    method & ball & cat & average \\
    \midrule
    ls & 4.50 & \textbf{9.00} & 6.75 \\
    spline-net & \textbf{3.25} & \textbf{9.00} & \textbf{6.13} \\
    \bottomrule
  \end{tabular}
\end{table*}
"""


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
