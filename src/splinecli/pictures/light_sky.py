"""Where a capture's lights stand, seen from the camera: the disc that observation maps are drawn on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.pictures.plotting import png_bytes

_RINGS_DEG = (15, 30, 45, 60, 75)  # from the view axis


def sky_plot(light_directions: NDArray[np.float64], title: str) -> bytes:
    """PNG of the lights (F, 3) at their (x, y), numbered from 1; rings are angles from the view axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    angle = np.linspace(0, 2 * np.pi, 361)
    for ring_deg in (*_RINGS_DEG, 90):
        radius = np.sin(np.radians(ring_deg))
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color="0.8", linewidth=1, zorder=1)
        if ring_deg < 90:  # beside 75 degrees there is no room for it
            axes.text(0, -radius, f"{ring_deg}°", color="0.5", fontsize=8, ha="center", va="bottom")
    x, y = light_directions[:, 0], light_directions[:, 1]
    axes.scatter(x, y, s=30, color="#D55E00", zorder=3)
    for number, place in enumerate(zip(x, y, strict=True), start=1):
        axes.annotate(str(number), place, xytext=(4, 4), textcoords="offset points", fontsize=7, zorder=3)
    axes.set_title(title)
    axes.set_axis_off()
    return png_bytes(figure, 120)
