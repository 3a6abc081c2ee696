"""The whole text of every document of an evaluation stands in tests/golden/.

Paired tests are compared with a textbook's example, SciPy's two-sample form and corrections done by
hand.
"""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from pytest import approx
from scipy import stats

from evaluation.conftest import evaluation_of
from scenes import parametrize
from splinecli.evaluation.document import html_report, results_csv, results_document
from splinecli.evaluation.protocol import Evaluation, Protocol, Result
from splinecli.evaluation.tables import (
    AVERAGE,
    compare,
    holm,
    latex,
    markdown,
    trial_averages,
)
from splinecli.records.documents import SkippedCapture

TEN = Evaluation(
    Protocol(n_lights=10, trials=2, seed=7, max_pixels=500),
    (
        Result("ls", "ball", 10, (4.0, 5.0), 0.00125),
        Result("spline-net", "ball", 10, (3.25, 3.25), 1.5),
        Result("ls", "cat", 10, (9.001, 9.003), 0.001),
        Result("spline-net", "cat", 10, (9.004, 9.004), 1.25),
    ),
    (SkippedCapture(capture="bear", reason="bear: no images."),),
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


def test_whole_documents(golden):
    """Of the comparisons by hand: differences 0.75 and 1.75, t = 1.25 / 0.5 = 2.5 with one degree
    of freedom, where t's distribution is Cauchy's: p = 1 - 2 atan(2.5) / pi = 0.242, and 0.5
    tan(0.95 pi / 2) = 6.3531."""
    both = [TEN, ALL]
    for suffix, text in (
        ("md", markdown(both)),
        ("csv", results_csv(both)),
        ("tex", latex([TEN])),
        ("json", json.dumps(results_document(both), indent=1) + "\n"),
    ):
        golden(f"evaluation_results.{suffix}", text)


@parametrize(
    "name, shown",
    [
        ("a|b", r"a\|b"),
        ("![a](javascript:alert(1)) &lt; ~~b~~", r"!\[a\](javascript:alert(1)) \&lt; \~\~b\~\~"),
    ],
)
def test_names_are_text_in_markdown(name, shown):
    odd = replace(TEN, results=(replace(TEN.results[0], capture=name),))
    assert markdown([odd]).startswith(f"| method | {shown} | average |\n")


def test_light_noise_tells_evaluations_apart():
    noisy = replace(TEN, protocol=replace(TEN.protocol, light_noise_deg=2.5))
    document = results_document([TEN, noisy])
    assert document["protocol"]["n_lights"] == 10
    assert document["protocol"]["light_noise_deg"] == [0.0, 2.5]
    assert list(document["averages"]["ls"]) == ["0", "2.5"]
    assert list(results_document([TEN, ALL, noisy])["averages"]["ls"]) == [
        "10, 0",
        "all, 0",
        "10, 2.5",
    ]
    assert "## 10 lights, light noise of 2.5 degrees\n" in markdown([TEN, noisy])


@parametrize("as_stored", [False, True])
def test_every_document_names_how_the_captures_were_read(as_stored):
    evaluation = replace(TEN, protocol=replace(TEN.protocol, as_stored=as_stored))
    words = "images as stored." if as_stored else "images restored."
    assert words in markdown([evaluation]) and words in latex([evaluation])
    document = results_document([evaluation])
    assert document["protocol"]["as_stored"] is as_stored
    assert {record["as_stored"] for record in document["results"]} == {as_stored}
    rows = csv.DictReader(results_csv([evaluation]).splitlines())
    assert {row["as_stored"] for row in rows} == {str(as_stored)}
    shown = (
        "as stored: nothing restored"
        if as_stored
        else "lens blur removed, saturated observations restored"
    )
    assert shown in html_report([evaluation], [], [])


def test_latex_escapes_names():
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


# Student's own example (Biometrika 1908): hours of sleep that two drugs gained ten patients.
FIRST = (0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0)
SECOND = (1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4)


def test_students_example():
    comparison, average = compare(evaluation_of({"ball": {"ls": FIRST, "iw12": SECOND}}))
    # As R's t.test(extra ~ group, paired = TRUE) prints it.
    assert comparison.p_value == approx(0.002833, abs=5e-7)
    assert comparison.interval_deg == approx((-2.4598858, -0.7001142), abs=5e-8)
    assert comparison.difference_deg == approx(-1.58)
    # squares about the mean, by hand
    assert comparison.std_deg == approx(np.sqrt(13.616 / 10))
    assert comparison.first == "ls"
    assert comparison.second == "iw12"
    assert comparison.trials == 10
    assert comparison.p_holm == comparison.p_value  # one pair
    assert comparison.differs
    assert average.capture == AVERAGE
    assert average.p_value == approx(comparison.p_value)


def test_holm_by_hand():
    # m = 4: 0.01 * 4; 0.03 * 3 = 0.09; 0.04 * 2 = 0.08, held up by 0.09; 0.9 * 1.
    assert holm([0.04, 0.01, 0.9, 0.03]) == approx([0.09, 0.04, 0.9, 0.09])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


def test_every_pair_on_every_capture_and_on_their_average():
    generator = np.random.default_rng(1)
    draws = {
        capture: {
            method: tuple(generator.normal(mean, 0.5, 8))
            for method, mean in (("a", 5), ("b", 6), ("c", 5.2))
        }
        for capture in ("ball", "cat", "cow")
    }
    comparisons = compare(evaluation_of(draws))
    assert [(c.capture, c.first, c.second) for c in comparisons] == [
        (capture, *pair)
        for capture in ("ball", "cat", "cow", AVERAGE)
        for pair in (("a", "b"), ("a", "c"), ("b", "c"))
    ]
    for c in comparisons:
        captures = draws.values() if c.capture == AVERAGE else [draws[c.capture]]
        first, second = (
            np.mean([methods[m] for methods in captures], axis=0) for m in (c.first, c.second)
        )
        oracle = stats.ttest_rel(first, second)
        assert c.p_value == approx(oracle.pvalue)
        assert c.interval_deg == approx(tuple(oracle.confidence_interval(0.95)))
    for capture in ("ball", AVERAGE):
        of_one = [c for c in comparisons if c.capture == capture]
        assert [c.p_holm for c in of_one] == approx(holm([c.p_value or 0 for c in of_one]))


@parametrize(
    "first, second, interval, p_value, differs",
    [
        ((4.0,), (5.0,), None, None, None),  # one trial
        ((4.0, 5.0, 6.0), (4.5, 5.5, 6.5), None, None, None),  # no spread
        ((4.1, 5.2), (4.1, 5.2), (0.0, 0.0), 1.0, False),  # the same method twice
        ((4.1, 5.2), (4.1 + 1e-8, 5.2 - 1e-8), (0.0, 0.0), 1.0, False),  # but for rounding
    ],
)
def test_where_there_is_nothing_to_test(first, second, interval, p_value, differs):
    for comparison in compare(evaluation_of({"ball": {"a": first, "b": second}})):
        assert comparison.interval_deg == interval
        assert comparison.p_value == comparison.p_holm == p_value
        assert comparison.differs is differs
        assert np.isfinite([comparison.difference_deg, comparison.std_deg]).all()


def test_pairs_without_a_test_do_not_count_in_the_correction():
    shifted = tuple(value + 1 for value in FIRST)
    comparisons = compare(evaluation_of({"ball": {"a": FIRST, "b": SECOND, "c": shifted}}))
    on_ball = {(c.first, c.second): c for c in comparisons if c.capture == "ball"}
    assert on_ball["a", "c"].p_holm is None
    tested = [on_ball["a", "b"], on_ball["b", "c"]]
    assert [each.p_holm for each in tested] == approx(holm([each.p_value for each in tested]))


def test_the_average_takes_the_trials_all_captures_have():
    uneven = evaluation_of({"ball": {"a": (1.0, 2.0, 9.0)}, "cat": {"a": (3.0, 5.0)}})
    assert trial_averages(uneven, "a") == (2.0, 3.5)
