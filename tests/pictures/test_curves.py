"""Plots: curves leave out what was not computed, and anything may be a title."""

from typing import Any

import numpy as np
import pytest

from splinecli.pictures.plots import sky_plot, training_figure

COLUMNS: dict[str, list[float | None]] = {
    "step": [50, 100, 125], "loss": [2.0, 1.0, 0.5], "symmetric": [None, 0.5, None], "asymmetric": [None] * 3,
    "angle_deg": [20.0, 10.0, 8.0], "validation_deg": [None, 12.5, 9.0],
    "map_error": [0.2, 0.1, 0.08], "masked_map_error": [0.1, 0.05, 0.04],
}  # fmt: skip


def lines(axes: Any) -> dict[str, list[list[float]]]:
    return {line.get_label(): [list(map(float, values)) for values in line.get_data()] for line in axes.lines}


def test_each_curve_leaves_out_what_was_not_computed() -> None:
    loss, angle, maps = training_figure(COLUMNS).axes
    steps = [50, 100, 125]
    assert lines(loss) == {"weighted sum": [steps, [2.0, 1.0, 0.5]], "Ls, unweighted": [[100], [0.5]]}
    assert lines(angle) == {"training": [steps, [20, 10, 8]], "validation": [[100, 125], [12.5, 9]]}
    assert lines(maps) == {"all cells": [steps, [0.2, 0.1, 0.08]], "cells with a light": [steps, [0.1, 0.05, 0.04]]}
    assert {axes.get_xlabel() for axes in (loss, angle, maps)} == {"step"}
    assert loss.get_title() == "loss"
    assert loss.get_yscale() == "linear"


def test_scales_and_hidden_axes() -> None:
    """Wide curves are logarithmic unless a value is zero; without a LI-Net, the map errors are hidden."""
    for middle, scale in ((1.0, "log"), (0.0, "linear")):
        assert training_figure(COLUMNS | {"loss": [50.0, middle, 0.5]}).axes[0].get_yscale() == scale
    columns = COLUMNS | {"map_error": [None] * 3, "masked_map_error": [None] * 3}
    assert [axes.get_visible() for axes in training_figure(columns).axes] == [True, True, False]


LIGHTS = np.array([(0, 0, 1), (0.6, 0, 0.8)])


@pytest.mark.parametrize("name", ["b\udcff", "a\nb\x1b[2J", r"$\frac$"])
def test_a_name_that_is_not_printable_or_a_formula(name: str) -> None:
    assert sky_plot(LIGHTS, name) != sky_plot(LIGHTS, "")
