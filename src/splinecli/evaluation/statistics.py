"""Whether two methods differ by more than the draws of lights make them differ.

Methods see the same draws, and a draw that is hard for one is mostly hard for the other. So the differences trial by
trial are tested, not the two spreads: a paired t-test (Student, Biometrika 1908), with the correction of Holm
(Scandinavian Journal of Statistics 1979) over the pairs of methods on one capture. What is tested is the spread over
draws: a difference beyond it holds for this capture under other lights, not for other captures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from splinecli.evaluation.records import Evaluation

AVERAGE = "average"
"""What stands for all captures together where a capture's name is expected."""

SIGNIFICANCE = 0.05

# Error maps are float32: MAEs closer than this are equal.
_SAME_DEG = 1e-6


@dataclass(frozen=True)
class Comparison:
    """Two methods on one capture, or on the average over the captures (AVERAGE), trial by trial.

    Without a test, interval_deg, p_value and p_holm are None: with one trial, and where the trials' differences are
    all the same but not zero, which is one trial told several times. Where they are all zero, the interval is (0, 0)
    and p is 1. "The same" is to 1e-6 degrees, the precision of the error maps.

    trials: those that were paired. difference_deg, std_deg: mean and population standard deviation over them of the
    MAE of `first` minus that of `second`; below zero `first` is better. interval_deg: of 95 % for the mean
    difference. p_value: two-sided. p_holm: the same, corrected for the number of pairs tested on this capture; the
    interval is not, so it may leave zero out where p_holm is above SIGNIFICANCE.
    """

    capture: str
    first: str
    second: str
    trials: int
    difference_deg: float
    std_deg: float
    interval_deg: tuple[float, float] | None
    p_value: float | None
    p_holm: float | None

    @property
    def differs(self) -> bool | None:
        """Whether p_holm is below SIGNIFICANCE; None without a test."""
        return None if self.p_holm is None else self.p_holm < SIGNIFICANCE


def compare(evaluation: Evaluation) -> tuple[Comparison, ...]:
    """Every pair of methods on every capture, then on the average over the captures; none of one method alone.

    On the average, trial t is the mean of trial t of every capture (trial_averages).
    """
    comparisons: list[Comparison] = []
    for capture in evaluation.captures:
        comparisons += _compare_all(
            capture, {r.method: r.maes_deg for r in evaluation.results if r.capture == capture}
        )
    averages = {method: trial_averages(evaluation, method) for method in evaluation.methods}
    return (*comparisons, *_compare_all(AVERAGE, averages))


def trial_averages(evaluation: Evaluation, method: str) -> tuple[float, ...]:
    """The method's MAE in degrees of each trial, averaged over the captures.

    A capture's only trial, as where it has K lights in all, stands for each of the others' trials. Where numbers of
    trials differ otherwise, the trials that every capture has.
    """
    maes_deg = [result.maes_deg for result in evaluation.results if result.method == method]
    most = max(map(len, maes_deg))
    repeated = [trials * most if len(trials) == 1 else trials for trials in maes_deg]
    return tuple(float(np.mean(trial)) for trial in zip(*repeated, strict=False))


def in_words(comparison: Comparison) -> str:
    """A comparison as a sentence."""
    c = comparison
    better, worse = (c.first, c.second) if c.difference_deg < 0 else (c.second, c.first)
    size = f"{abs(c.difference_deg):.2f} degrees"
    if c.interval_deg is None or c.p_holm is None:
        reason = "one trial" if c.trials == 1 else f"the same in all {c.trials} trials"
        return f"{better} scores {size} less than {worse} ({reason}: not tested)."
    test = f"{p_in_words(c.p_holm)}, {c.trials} trials"
    low, high = c.interval_deg
    if c.differs:
        low, high = sorted((abs(low), abs(high)))
        return f"{better} is better than {worse} by {size} (95 % interval {low:.2f} to {high:.2f}, {test})."
    interval = f"95 % interval {low:+.2f} to {high:+.2f}"
    return f"{c.first} and {c.second} cannot be told apart ({c.difference_deg:+.2f} degrees, {interval}, {test})."


def p_in_words(p_value: float) -> str:
    """A p-value as text: "p < 0.001", "p = 0.032"."""
    return "p < 0.001" if p_value < 0.001 else f"p = {p_value:.3f}" if p_value < 0.1 else f"p = {p_value:.2f}"


def _compare_all(capture: str, maes_deg: dict[str, tuple[float, ...]]) -> list[Comparison]:
    pairs = combinations(maes_deg, 2)
    found = [_compare(capture, a, b, np.array(maes_deg[a]), np.array(maes_deg[b])) for a, b in pairs]
    corrected = iter(holm([c.p_value for c in found if c.p_value is not None]))
    return [c if c.p_value is None else replace(c, p_holm=next(corrected)) for c in found]


def _compare(
    capture: str, first: str, second: str, a: NDArray[np.float64], b: NDArray[np.float64]
) -> Comparison:
    differences = a - b
    interval, p_value = _paired_test(differences)
    mean, std = float(differences.mean()), float(differences.std())
    return Comparison(capture, first, second, len(differences), mean, std, interval, p_value, None)


def _paired_test(differences: NDArray[np.float64]) -> tuple[tuple[float, float] | None, float | None]:
    """The interval of 95 % and the p-value of a t-test of differences (T,) against zero."""
    if len(differences) < 2:
        return None, None
    if np.abs(differences).max() < _SAME_DEG:
        return (0.0, 0.0), 1.0
    if np.ptp(differences) < _SAME_DEG:
        return None, None
    from scipy import stats

    test = stats.ttest_1samp(differences, 0)
    low, high = test.confidence_interval(1 - SIGNIFICANCE)
    return (float(low), float(high)), float(test.pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: the k-th smallest of m times m + 1 - k, never falling, at most 1."""
    order = np.argsort(p_values, kind="stable")
    stepped = np.array(p_values)[order] * np.arange(len(p_values), 0, -1)
    corrected = np.empty(len(p_values))
    corrected[order] = np.maximum.accumulate(stepped).clip(max=1)
    return [float(p) for p in corrected]
