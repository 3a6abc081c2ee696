"""The learning curves of a training run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LARGEST_LINEAR_RATIO = 20  # An axis whose values span more is logarithmic.

Columns = Mapping[str, Sequence[float | None]]


def training_figure(columns: Columns) -> Figure:
    """Return a matplotlib figure of the loss, the angular errors and the map errors against the step.

    `columns` are those of metrics.csv by name, all of one length; None marks a value that was not computed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    loss, angle, maps = figure.subplots(1, 3)
    loss.set_title("loss")
    _plot(loss, columns, "loss", "weighted sum")
    _plot(loss, columns, "symmetric", "Ls, unweighted", alpha=0.5)
    _plot(loss, columns, "asymmetric", "La, unweighted", alpha=0.5)
    angle.set_title("mean angular error (deg)")
    _plot(angle, columns, "angle_deg", "training", alpha=0.5)
    _plot(angle, columns, "validation_deg", "validation", style="o-")
    maps.set_title("mean error of the dense map")
    _plot(maps, columns, "map_error", "all cells")
    _plot(maps, columns, "masked_map_error", "cells with a light")
    for axes in (loss, angle, maps):
        _finish(axes)
    return figure


def _plot(axes: Axes, columns: Columns, name: str, label: str, *, style: str = "-", alpha: float = 1) -> None:
    points = [(step, value) for step, value in zip(columns["step"], columns[name], strict=True) if value is not None]
    if points:
        style = "o" if len(points) == 1 else style  # one point is no line
        axes.plot(*zip(*points, strict=True), style, label=label, alpha=alpha)


def _finish(axes: Axes) -> None:
    """Add the grid, the legend and the scale, or hide axes without a curve."""
    axes.set_visible(bool(axes.lines))
    if not axes.lines:
        return
    axes.set_xlabel("step")
    axes.grid(alpha=0.3)
    axes.legend()
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
    if (values > 0).all() and values.max() > _LARGEST_LINEAR_RATIO * values.min():
        axes.set_yscale("log")
