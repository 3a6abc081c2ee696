"""Plots of the error against a setting of the evaluation, such as the number of lights or the light noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from splinecli.errors import printable
from splinecli.pictures.plotting import MethodStyle, method_styles, png_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_INCHES = (3.2, 2.7)
_MOST_ACROSS = 3
_DPI = 200
_SMALL, _LARGE = 8, 9  # points: the text of a paper's figure
# matplotlib's dashes: an offset, then lengths of ink and gaps in line widths
_Dashes = tuple[float, tuple[float, ...]]
_DASHES: tuple[_Dashes, ...] = ((0, ()), (0, (4, 2)), (0, (1, 1.5)), (0, (5, 1.5, 1, 1.5)))
_NEAREST_TICKS = 0.045  # share of the axis: labels that are closer would overlap


class Point(NamedTuple):
    """A point of a curve: its place on the x axis, the mean error, and the standard deviation over the trials."""

    x: float
    mae_deg: float
    std_deg: float


@dataclass(frozen=True)
class Panel:
    """One plot.

    Args:
        title: title of the plot.
        ticks: labels on the x axis by their places.
        curves: points, in rising order, by method and series. All methods of a series have the same dashes.
    """

    title: str
    ticks: Mapping[float, str]
    curves: Mapping[tuple[str, str], Sequence[Point]]


def error_curves(panels: Sequence[Panel], *, label: str, logarithmic: bool = False) -> bytes:
    """Return panels side by side as PNG, with one legend for all.

    A curve has a band of one standard deviation to either side. Its colour and marker show the method, its dashes the
    series. The legend names the series where there are several.

    Args:
        panels: at least one, all with the same methods and series.
        label: label of the x axes.
        logarithmic: whether the x axes are logarithmic.
    """
    from matplotlib.figure import Figure

    methods = list(dict.fromkeys(method for method, _ in panels[0].curves))
    series = list(dict.fromkeys(name for _, name in panels[0].curves))
    styles = method_styles(methods)
    dashes = {name: _DASHES[i % len(_DASHES)] for i, name in enumerate(series)}
    across = 2 if len(panels) == 4 else min(len(panels), _MOST_ACROSS)
    down = math.ceil(len(panels) / across)

    figure = Figure(figsize=(_PANEL_INCHES[0] * across, _PANEL_INCHES[1] * down + 0.4), layout="constrained")
    places = figure.subplots(down, across, squeeze=False).flat
    for panel, axes in zip_longest(panels, places):
        if panel is None:
            axes.set_axis_off()
            continue
        for (method, name), points in panel.curves.items():
            _draw_curve(axes, points, styles[method], dashes[name])
        _set_x_axis(axes, panel.ticks, logarithmic=logarithmic)
        axes.set_title(printable(panel.title), fontsize=_LARGE, parse_math=False)
        axes.set_xlabel(label, fontsize=_SMALL)
        axes.set_ylabel("mean angular error (deg)", fontsize=_SMALL)
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize=_SMALL)
        axes.grid(alpha=0.3)
    _add_legend(figure, styles, dashes, across)
    return png_bytes(figure, _DPI)


def _draw_curve(axes: Axes, points: Sequence[Point], style: MethodStyle, dashes: _Dashes) -> None:
    x, mae_deg, std_deg = np.array(points).T
    axes.plot(x, mae_deg, color=style.colour, marker=style.marker, markersize=4, linewidth=1.2, linestyle=dashes)
    if std_deg.any():
        axes.fill_between(x, mae_deg - std_deg, mae_deg + std_deg, color=style.colour, alpha=0.2, linewidth=0)


def _add_legend(figure: Figure, styles: Mapping[str, MethodStyle], dashes: Mapping[str, _Dashes], across: int) -> None:
    from matplotlib.lines import Line2D

    handles = [  # a dollar sign would begin a formula
        Line2D([], [], color=style.colour, marker=style.marker, markersize=4, label=method.replace("$", r"\$"))
        for method, style in styles.items()
    ]
    if len(dashes) > 1:
        handles += [Line2D([], [], color="0.3", linestyle=style, label=name) for name, style in dashes.items()]
    columns = min(len(handles), 2 * across)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=_SMALL)


def _set_x_axis(axes: Axes, ticks: Mapping[float, str], *, logarithmic: bool) -> None:
    """Set ticks at the points. A label that would overlap the one before it is left out."""
    from matplotlib.ticker import NullLocator

    if logarithmic:
        axes.set_xscale("log", base=2)
    place = {x: math.log2(x) if logarithmic else x for x in sorted(ticks)}
    span = max(place.values()) - min(place.values())
    labels, last = [], -math.inf
    for x, position in place.items():
        fits = position - last > _NEAREST_TICKS * span
        labels.append(ticks[x] if fits else "")
        last = position if fits else last
    axes.set_xticks(list(place), labels)
    axes.xaxis.set_minor_locator(NullLocator())
