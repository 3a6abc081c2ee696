"""A plot of the light directions of a capture as the camera sees them, on the disc of observation maps."""

import numpy as np

from splinecli.errors import printable
from splinecli.maths import Doubles
from splinecli.maths.normals import unit
from splinecli.pictures.plotting import png_bytes

_RINGS_DEG = (15, 30, 45, 60, 75)  # from the viewing direction


def sky_plot(light_directions: Doubles, title: str, *, errors_deg: Doubles | None = None) -> bytes:
    """Return a PNG of the light directions (F, 3) at their (x, y), numbered from 1.

    The rings are angles from the viewing direction, in degrees. With expected errors (F,), a circle of this radius is
    drawn around each light.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    angle = np.linspace(0, 2 * np.pi, 361)
    for ring_deg in (*_RINGS_DEG, 90):
        radius = np.sin(np.radians(ring_deg))
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color="0.8", linewidth=1, zorder=1)
        if ring_deg < 90:  # the label of 90 degrees would overlap that of 75 degrees
            axes.text(0, -radius, f"{ring_deg}°", color="0.5", fontsize=8, ha="center", va="bottom")
    x, y = light_directions[:, 0], light_directions[:, 1]
    for outline in [] if errors_deg is None else _circles(light_directions, np.radians(errors_deg), angle):
        axes.plot(*outline.T, color="#D55E00", alpha=0.4, linewidth=1, zorder=2)
    axes.scatter(x, y, s=30, color="#D55E00", zorder=3)
    for number, place in enumerate(zip(x, y, strict=True), start=1):
        axes.annotate(str(number), place, xytext=(4, 4), textcoords="offset points", fontsize=7, zorder=3)
    axes.set_title(printable(title), parse_math=False)
    axes.set_axis_off()
    return png_bytes(figure, 120)


def _circles(directions: Doubles, radii: Doubles, angle: Doubles) -> Doubles:
    """Return the x and y (F, N, 2) of circles on the sphere around directions (F, 3), with radii (F,) in radians."""
    across = unit(np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)]))
    turned = np.cross(directions, across)
    around = across[:, None] * np.cos(angle)[:, None] + turned[:, None] * np.sin(angle)[:, None]
    cosine, sine = np.cos(radii)[:, None, None], np.sin(radii)[:, None, None]
    return np.asarray((directions[:, None] * cosine + around * sine)[..., :2])
