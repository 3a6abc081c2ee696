"""Plots of the error against the setting in which evaluations differ: the number of lights or the light noise.

All functions take several evaluations of the same methods. They plot only the captures that all evaluations scored, so
that every point of an average stands for the same captures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np

from splinecli.errors import printable
from splinecli.evaluation.protocol import Evaluation, lights_in_words
from splinecli.evaluation.statistics import AVERAGE, trial_averages
from splinecli.pictures.plotting import method_styles, png_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_CAPTURES = 4
"""Number of captures up to which each has a panel. With more, only the average has one, so that it can be read."""

_PANEL_INCHES = (3.2, 2.7)
_MOST_ACROSS = 3
_DPI = 200
_SMALL, _LARGE = 8, 9  # points: the text of a paper's figure
# matplotlib's dashes: an offset, then lengths of ink and gaps in line widths
_DASHES: tuple[tuple[float, tuple[float, ...]], ...] = ((0, ()), (0, (4, 2)), (0, (1, 1.5)), (0, (5, 1.5, 1, 1.5)))
_NEAREST_TICKS = 0.045  # share of the axis: labels that are closer would overlap


def lights_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Return a PNG of the error against the number of lights K, on a logarithmic axis.

    Each capture has a panel, and so has their average; with one capture, or more than MOST_CAPTURES, there is only the
    panel of the average. "all" is plotted at the capture's number of lights; in the panel of the average, at the
    mean number. If the light noise differs too, each of its values has its own dashes.
    """
    return _curves(
        evaluations,
        x=lambda e, capture: float(np.mean([r.n_lights for r in e.results if capture in (AVERAGE, r.capture)])),
        tick=lambda e, x: f"{x:.0f}\n(all)" if e.protocol.n_lights is None else f"{x:g}",
        series=lambda e: f"light noise {e.protocol.light_noise_deg:g} deg",
        label="number of lights",
        logarithmic=True,
    )


def light_noise_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Return a PNG of the error against the light noise, with the panels of lights_curves.

    Where the number of lights differs too, each number has its own dashes.
    """
    return _curves(
        evaluations,
        x=lambda e, _: e.protocol.light_noise_deg,
        tick=lambda _, x: f"{x:g}",
        series=lambda e: lights_in_words(e.protocol),
        label="light noise (standard deviation, deg)",
        logarithmic=False,
    )


def _curves(
    evaluations: Sequence[Evaluation],
    *,
    x: Callable[[Evaluation, str], float],
    tick: Callable[[Evaluation, float], str],
    series: Callable[[Evaluation], str],
    label: str,
    logarithmic: bool,
) -> bytes:
    """Return the panels side by side as PNG, with one curve for each method and series, and one legend for all.

    A curve has a band of one standard deviation to either side. Its colour and marker show the method, its dashes the
    series. `x` gives an evaluation's place on a capture's x axis, `tick` the label there, `series` the name of its
    curves.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    common = set.intersection(*(set(evaluation.captures) for evaluation in evaluations))
    evaluations = [replace(e, results=tuple(r for r in e.results if r.capture in common)) for e in evaluations]
    captures = evaluations[0].captures
    shown = [*captures, AVERAGE] if 1 < len(captures) <= MOST_CAPTURES else [AVERAGE]
    styles = method_styles(evaluations[0].methods)
    dashes = {name: _DASHES[i % len(_DASHES)] for i, name in enumerate(dict.fromkeys(map(series, evaluations)))}
    across = 2 if len(shown) == 4 else min(len(shown), _MOST_ACROSS)
    down = math.ceil(len(shown) / across)

    figure = Figure(figsize=(_PANEL_INCHES[0] * across, _PANEL_INCHES[1] * down + 0.4), layout="constrained")
    for capture, axes in zip_longest(shown, figure.subplots(down, across, squeeze=False).flat):
        if capture is None:
            axes.set_axis_off()
            continue
        in_order = sorted(evaluations, key=lambda e: x(e, capture))
        for method, style in styles.items():
            for name, pattern in dashes.items():
                points = [(x(e, capture), *_error(e, method, capture)) for e in in_order if series(e) == name]
                place, mae_deg, std_deg = np.array(points).T
                line = {"color": style.colour, "marker": style.marker, "linestyle": pattern}
                axes.plot(place, mae_deg, markersize=4, linewidth=1.2, **line)
                if std_deg.any():
                    low, high = mae_deg - std_deg, mae_deg + std_deg
                    axes.fill_between(place, low, high, color=style.colour, alpha=0.2, linewidth=0)
        _set_ticks(axes, {x(e, capture): tick(e, x(e, capture)) for e in in_order}, logarithmic=logarithmic)
        average = captures[0] if len(captures) == 1 else f"average of {len(captures)} captures"
        title = average if capture == AVERAGE else capture
        axes.set_title(printable(title), fontsize=_LARGE, parse_math=False)
        axes.set_xlabel(label, fontsize=_SMALL)
        axes.set_ylabel("mean angular error (deg)", fontsize=_SMALL)
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize=_SMALL)
        axes.grid(alpha=0.3)
    handles = [  # a dollar sign would begin a formula
        Line2D([], [], color=style.colour, marker=style.marker, markersize=4, label=method.replace("$", r"\$"))
        for method, style in styles.items()
    ]
    if len(dashes) > 1:
        handles += [Line2D([], [], color="0.3", linestyle=style, label=name) for name, style in dashes.items()]
    columns = min(len(handles), 2 * across)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=_SMALL)
    return png_bytes(figure, _DPI)


def _error(evaluation: Evaluation, method: str, capture: str) -> tuple[float, float]:
    """Return the mean error of a method on a capture or the average, and its standard deviation over the trials."""
    if capture == AVERAGE:
        return evaluation.averages[method], float(np.std(trial_averages(evaluation, method)))
    result = next(r for r in evaluation.results if (r.method, r.capture) == (method, capture))
    return result.mae_deg, result.std_deg


def _set_ticks(axes: Axes, ticks: dict[float, str], *, logarithmic: bool) -> None:
    """Set ticks, in rising order, at the points. A label that would overlap the one before it is left out."""
    from matplotlib.ticker import NullLocator

    if logarithmic:
        axes.set_xscale("log", base=2)
    place = {x: math.log2(x) if logarithmic else x for x in ticks}
    span = max(place.values()) - min(place.values())
    labels, last = [], -math.inf
    for x, position in place.items():
        fits = position - last > _NEAREST_TICKS * span
        labels.append(ticks[x] if fits else "")
        last = position if fits else last
    axes.set_xticks(list(place), labels)
    axes.xaxis.set_minor_locator(NullLocator())
