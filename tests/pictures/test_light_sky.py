"""Titles of plots are names of captures, in which anything may stand."""

from __future__ import annotations

import numpy as np
import pytest

from splinecli.pictures.light_sky import sky_plot

LIGHTS = np.array([(0, 0, 1), (0.6, 0, 0.8)])


@pytest.mark.parametrize("name", ["b\udcff", "a\nb\x1b[2J", r"$\frac$"])
def test_a_name_that_is_not_printable_or_a_formula(name: str) -> None:
    assert sky_plot(LIGHTS, name) != sky_plot(LIGHTS, "")
