"""Plots of the error against the setting in which evaluations differ: the number of lights or the light noise.

All functions take several evaluations of the same methods. They plot only the captures that all evaluations scored, so
that every point of an average stands for the same captures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from splinecli.evaluation.outcome import Evaluation
from splinecli.evaluation.protocol import lights_in_words
from splinecli.evaluation.statistics import AVERAGE, trial_averages
from splinecli.pictures.curves import Panel, Point, error_curves

MOST_CAPTURES = 4
"""Number of captures up to which each has a panel. With more, only the average has one, so that it can be read."""


def lights_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Return a PNG of the error against the number of lights K, on a logarithmic axis.

    Each capture has a panel, and so has their average; with one capture, or more than MOST_CAPTURES, there is only the
    panel of the average. "all" is plotted at the capture's number of lights; in the panel of the average, at the
    mean number. If the light noise differs too, each of its values has its own dashes.
    """
    return error_curves(
        _panels(
            evaluations,
            x=_mean_lights,
            tick=lambda evaluation, x: f"{x:.0f}\n(all)" if evaluation.protocol.n_lights is None else f"{x:g}",
            series=lambda evaluation: f"light noise {evaluation.protocol.light_noise_deg:g} deg",
        ),
        label="number of lights",
        logarithmic=True,
    )


def light_noise_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Return a PNG of the error against the light noise, with the panels of lights_curves.

    Where the number of lights differs too, each number has its own dashes.
    """
    return error_curves(
        _panels(
            evaluations,
            x=lambda evaluation, _: evaluation.protocol.light_noise_deg,
            tick=lambda _, x: f"{x:g}",
            series=lambda evaluation: lights_in_words(evaluation.protocol),
        ),
        label="light noise (standard deviation, deg)",
    )


def _panels(
    evaluations: Sequence[Evaluation],
    *,
    x: Callable[[Evaluation, str], float],
    tick: Callable[[Evaluation, float], str],
    series: Callable[[Evaluation], str],
) -> list[Panel]:
    """Return the panels, with one curve for each method and series.

    Args:
        x: the place of an evaluation on a capture's x axis.
        tick: the label at this place.
        series: the name of the curves that the evaluation belongs to.
    """
    evaluations = _on_common_captures(evaluations)
    captures = evaluations[0].captures
    shown = [*captures, AVERAGE] if 1 < len(captures) <= MOST_CAPTURES else [AVERAGE]
    names = list(dict.fromkeys(map(series, evaluations)))
    return [
        Panel(
            _title(capture, captures),
            {x(e, capture): tick(e, x(e, capture)) for e in sorted(evaluations, key=lambda e: x(e, capture))},
            {
                (method, name): sorted(
                    _point(e, method, capture, x(e, capture)) for e in evaluations if series(e) == name
                )
                for method in evaluations[0].methods
                for name in names
            },
        )
        for capture in shown
    ]


def _on_common_captures(evaluations: Sequence[Evaluation]) -> list[Evaluation]:
    common = set.intersection(*(set(evaluation.captures) for evaluation in evaluations))
    return [replace(e, results=tuple(r for r in e.results if r.capture in common)) for e in evaluations]


def _mean_lights(evaluation: Evaluation, capture: str) -> float:
    return float(np.mean([r.n_lights for r in evaluation.results if capture in (AVERAGE, r.capture)]))


def _point(evaluation: Evaluation, method: str, capture: str, x: float) -> Point:
    if capture == AVERAGE:
        return Point(x, evaluation.averages[method], float(np.std(trial_averages(evaluation, method))))
    result = next(r for r in evaluation.results if (r.method, r.capture) == (method, capture))
    return Point(x, result.mae_deg, result.std_deg)


def _title(capture: str, captures: Sequence[str]) -> str:
    if capture != AVERAGE:
        return capture
    return captures[0] if len(captures) == 1 else f"average of {len(captures)} captures"
