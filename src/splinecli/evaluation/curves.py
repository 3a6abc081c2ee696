"""Plots of the error against what evaluations differ in: the number of lights, the light noise.

Several evaluations of the same methods come in; only captures that all of them have scored are drawn, so that points
of an average stand for the same captures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from splinecli.evaluation.records import Evaluation
from splinecli.evaluation.statistics import AVERAGE, trial_averages
from splinecli.pictures.plotting import method_looks, png_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_CAPTURES = 4
"""With more captures only the average is drawn: ten panels in a row cannot be read in print."""

_PANEL_INCHES = (3.2, 2.7)
_MOST_ACROSS = 3
_DPI = 200
_SMALL, _LARGE = 8, 9  # points: the text of a paper's figure
_Dashes = tuple[
    float, tuple[float, ...]
]  # matplotlib's: an offset, then lengths of ink and gaps in line widths
_DASHES: tuple[_Dashes, ...] = ((0, ()), (0, (4, 2)), (0, (1, 1.5)), (0, (5, 1.5, 1, 1.5)))
_NEAREST_TICKS = 0.045  # of the axis: labels nearer than this run into each other


def lights_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Error against the number of lights K, on a logarithmic axis; PNG.

    A panel for each capture and one for their average, this one alone with more than MOST_CAPTURES or with one. A
    line for each method, with a band of one standard deviation over the trials to either side. "all" stands at the
    capture's own number of lights, in the average at their mean. Where the light noise differs too, a line for each
    of its values, told by the dashes.
    """
    return _draw(
        evaluations,
        x=_n_lights,
        tick=lambda evaluation, x: f"{x:.0f}\n(all)" if evaluation.protocol.n_lights is None else f"{x:g}",
        other=lambda evaluation: f"light noise {evaluation.protocol.light_noise_deg:g} deg",
        label="number of lights",
        logarithmic=True,
    )


def light_noise_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Error against the light noise, with everything else as lights_curves has it; PNG."""
    return _draw(
        evaluations,
        x=lambda evaluation, _: evaluation.protocol.light_noise_deg,
        tick=lambda _, x: f"{x:g}",
        other=lambda e: "all lights" if e.protocol.n_lights is None else f"{e.protocol.n_lights} lights",
        label="light noise (standard deviation, deg)",
        logarithmic=False,
    )


class _Point(NamedTuple):
    x: float
    mae_deg: float
    std_deg: float


def _draw(
    evaluations: Sequence[Evaluation],
    *,
    x: Callable[[Evaluation, str], float],
    tick: Callable[[Evaluation, float], str],
    other: Callable[[Evaluation], str],
    label: str,
    logarithmic: bool,
) -> bytes:
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    evaluations = _on_common_captures(evaluations)
    captures, methods = evaluations[0].captures, evaluations[0].methods
    panels = [*captures, AVERAGE] if 1 < len(captures) <= MOST_CAPTURES else [AVERAGE]
    across = 2 if len(panels) == 4 else min(len(panels), _MOST_ACROSS)
    down = math.ceil(len(panels) / across)
    looks = method_looks(methods)
    others = list(dict.fromkeys(map(other, evaluations)))
    dashes = {value: _DASHES[i % len(_DASHES)] for i, value in enumerate(others)}

    figure = Figure(figsize=(_PANEL_INCHES[0] * across, _PANEL_INCHES[1] * down + 0.4), layout="constrained")
    places = list(figure.subplots(down, across, squeeze=False).flat)
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    for panel, axes in zip(panels, places, strict=False):
        for method in methods:
            for value in others:
                points = sorted(
                    _point(evaluation, method, panel, x(evaluation, panel))
                    for evaluation in evaluations
                    if other(evaluation) == value
                )
                _draw_line(axes, points, *looks[method], dashes[value])
        ticks = {x(e, panel): tick(e, x(e, panel)) for e in sorted(evaluations, key=lambda e: x(e, panel))}
        _set_x_axis(axes, ticks, logarithmic=logarithmic)
        _finish(axes, _title(panel, captures), label)

    handles = [
        Line2D([], [], color=looks[m].colour, marker=looks[m].marker, markersize=4, label=_plain(m))
        for m in methods
    ]
    if len(others) > 1:
        handles += [Line2D([], [], color="0.3", linestyle=dashes[v], label=v) for v in others]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=min(len(handles), 2 * across), fontsize=_SMALL
    )
    return png_bytes(figure, _DPI)


def _draw_line(axes: Axes, points: Sequence[_Point], colour: str, marker: str, dashes: _Dashes) -> None:
    x, mae_deg, std_deg = np.array(points).T
    axes.plot(x, mae_deg, color=colour, marker=marker, markersize=4, linewidth=1.2, linestyle=dashes)
    if std_deg.any():
        axes.fill_between(x, mae_deg - std_deg, mae_deg + std_deg, color=colour, alpha=0.2, linewidth=0)


def _finish(axes: Axes, title: str, label: str) -> None:
    axes.set_title(title, fontsize=_LARGE, parse_math=False)
    axes.set_xlabel(label, fontsize=_SMALL)
    axes.set_ylabel("mean angular error (deg)", fontsize=_SMALL)
    axes.set_ylim(bottom=0)
    axes.tick_params(labelsize=_SMALL)
    axes.grid(alpha=0.3)


def _set_x_axis(axes: Axes, ticks: dict[float, str], *, logarithmic: bool) -> None:
    """Ticks at the points, {x: label} in rising order; of labels that would run into each other the first."""
    from matplotlib.ticker import NullLocator

    if logarithmic:
        axes.set_xscale("log", base=2)
    place = {x: math.log2(x) if logarithmic else x for x in ticks}
    span = max(place.values()) - min(place.values())
    labels, last = [], -math.inf
    for x, text in ticks.items():
        fits = place[x] - last > _NEAREST_TICKS * span
        labels.append(text if fits else "")
        last = place[x] if fits else last
    axes.set_xticks(list(ticks), labels)
    axes.xaxis.set_minor_locator(NullLocator())


def _on_common_captures(evaluations: Sequence[Evaluation]) -> list[Evaluation]:
    common = set.intersection(*(set(evaluation.captures) for evaluation in evaluations))
    return [replace(e, results=tuple(r for r in e.results if r.capture in common)) for e in evaluations]


def _n_lights(evaluation: Evaluation, capture: str) -> float:
    return float(np.mean([r.n_lights for r in evaluation.results if capture in (AVERAGE, r.capture)]))


def _point(evaluation: Evaluation, method: str, panel: str, x: float) -> _Point:
    if panel == AVERAGE:
        return _Point(x, evaluation.averages[method], float(np.std(trial_averages(evaluation, method))))
    result = next(r for r in evaluation.results if (r.method, r.capture) == (method, panel))
    return _Point(x, result.mae_deg, result.std_deg)


def _title(panel: str, captures: Sequence[str]) -> str:
    if panel != AVERAGE:
        return panel
    return captures[0] if len(captures) == 1 else f"average of {len(captures)} captures"


def _plain(text: str) -> str:
    """Text in which matplotlib sees no formula."""
    return text.replace("$", r"\$")
