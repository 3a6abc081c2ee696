"""Paired tests against a textbook's example, SciPy's two-sample form and corrections done by hand."""

import numpy as np
import pytest
from scipy import stats

from splinecli.evaluation.protocol import Evaluation, Protocol, Result
from splinecli.evaluation.tables import AVERAGE, compare, holm, trial_averages


def evaluation_of(**maes_deg: dict[str, tuple[float, ...]]) -> Evaluation:
    """From {capture: {method: MAE of each trial}}."""
    pairs = ((capture, *item) for capture, methods in maes_deg.items() for item in methods.items())
    results = tuple(Result(method, capture, 10, maes, 1.0) for capture, method, maes in pairs)
    return Evaluation(Protocol(n_lights=10, trials=10), results)


# Student's own example (Biometrika 1908): hours of sleep that two drugs gained ten patients.
FIRST = (0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0)
SECOND = (1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4)


def test_students_example() -> None:
    comparison, average = compare(evaluation_of(ball={"ls": FIRST, "iw12": SECOND}))
    # As R's t.test(extra ~ group, paired = TRUE) prints it.
    assert comparison.p_value == pytest.approx(0.002833, abs=5e-7)
    assert comparison.interval_deg == pytest.approx((-2.4598858, -0.7001142), abs=5e-8)
    assert comparison.difference_deg == pytest.approx(-1.58)
    assert comparison.std_deg == pytest.approx(np.sqrt(13.616 / 10))  # squares about the mean, by hand
    assert (comparison.first, comparison.second, comparison.trials) == ("ls", "iw12", 10)
    assert comparison.p_holm == comparison.p_value  # one pair
    assert comparison.differs
    assert average.capture == AVERAGE
    assert average.p_value == pytest.approx(comparison.p_value)


def test_holm_by_hand() -> None:
    # m = 4: 0.01 * 4; 0.03 * 3 = 0.09; 0.04 * 2 = 0.08, held up by 0.09; 0.9 * 1.
    assert holm([0.04, 0.01, 0.9, 0.03]) == pytest.approx([0.09, 0.04, 0.9, 0.09])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


def test_every_pair_on_every_capture_and_on_their_average() -> None:
    generator = np.random.default_rng(1)
    draws = {
        capture: {method: tuple(generator.normal(mean, 0.5, 8)) for method, mean in (("a", 5), ("b", 6), ("c", 5.2))}
        for capture in ("ball", "cat", "cow")
    }
    comparisons = compare(evaluation_of(**draws))
    assert [(c.capture, c.first, c.second) for c in comparisons] == [
        (capture, *pair) for capture in ("ball", "cat", "cow", AVERAGE) for pair in (("a", "b"), ("a", "c"), ("b", "c"))
    ]
    for c in comparisons:
        captures = draws.values() if c.capture == AVERAGE else [draws[c.capture]]
        first, second = (np.mean([methods[m] for methods in captures], axis=0) for m in (c.first, c.second))
        oracle = stats.ttest_rel(first, second)
        assert c.p_value == pytest.approx(oracle.pvalue)
        assert c.interval_deg == pytest.approx(tuple(oracle.confidence_interval(0.95)))
    for capture in ("ball", AVERAGE):
        of_one = [c for c in comparisons if c.capture == capture]
        assert [c.p_holm for c in of_one] == pytest.approx(holm([c.p_value or 0 for c in of_one]))


@pytest.mark.parametrize(
    ("first", "second", "interval", "p_value", "differs"),
    [
        ((4.0,), (5.0,), None, None, None),  # one trial
        ((4.0, 5.0, 6.0), (4.5, 5.5, 6.5), None, None, None),  # no spread
        ((4.1, 5.2), (4.1, 5.2), (0.0, 0.0), 1.0, False),  # the same method twice
        ((4.1, 5.2), (4.1 + 1e-8, 5.2 - 1e-8), (0.0, 0.0), 1.0, False),  # but for rounding
    ],
)
def test_where_there_is_nothing_to_test(first, second, interval, p_value, differs):
    for comparison in compare(evaluation_of(ball={"a": first, "b": second})):
        assert comparison.interval_deg == interval
        assert comparison.p_value == comparison.p_holm == p_value
        assert comparison.differs is differs
        assert np.isfinite([comparison.difference_deg, comparison.std_deg]).all()


def test_pairs_without_a_test_do_not_count_in_the_correction() -> None:
    shifted = tuple(value + 1 for value in FIRST)
    comparisons = compare(evaluation_of(ball={"a": FIRST, "b": SECOND, "c": shifted}))
    on_ball = {(c.first, c.second): c for c in comparisons if c.capture == "ball"}
    assert on_ball["a", "c"].p_holm is None
    tested = [on_ball["a", "b"], on_ball["b", "c"]]
    assert [each.p_holm for each in tested] == pytest.approx(holm([each.p_value for each in tested]))


def test_the_average_takes_the_trials_all_captures_have() -> None:
    uneven = evaluation_of(ball={"a": (1.0, 2.0, 9.0)}, cat={"a": (3.0, 5.0)})
    assert trial_averages(uneven, "a") == (2.0, 3.5)
