"""Observation maps of single pixels, as in figure 3 of SPLINE-Net (Zheng et al., ICCV 2019)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splinecli.maths import Floats, Integers
from splinecli.pictures.plotting import png_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from splinecli.maths.observation_map import Grid

_MAP_INCHES = 1.7
_DPI = 150
_EMPTY = "0.85"  # light gray, which the colour scale does not contain
_SMALL, _LARGE = 8, 9  # points


def observation_map_figure(
    sparse: Floats,
    dense: Floats | None,
    truth: Floats | None,
    *,
    error_deg: Floats,
    pixels: Integers | None = None,
    truth_label: str = "true map, all lights",
    title: str = "",
    grid: Grid = "even",
) -> bytes:
    """Return a PNG file with a row for each of N pixels: sparse map, LI-Net's dense map, map of all lights.

    Row 0 of a map is y = +1. The maps of a pixel share one frame, that of the camera or that of the pixel. Values are
    relative to the largest observation, from 0 to 1. Empty cells are gray; the circle is the horizon.

    Args:
        sparse: (N, w, w), NaN in empty cells.
        dense: the same; None for a network without a LI-Net.
        truth: (N, w, w), NaN in cells without a value; None to leave it out.
        error_deg: (N,) errors of the estimated normals, in degrees.
        pixels: (N, 2) row and column in the image; None to leave them out.
        truth_label: label of the true maps.
        title: title of the figure; empty for none.
        grid: how light directions are assigned to cells.
    """
    from matplotlib.figure import Figure

    labelled = {"sparse map": sparse, "LI-Net's dense map": dense, truth_label: truth}
    columns = {label: maps for label, maps in labelled.items() if maps is not None}
    size = (_MAP_INCHES * len(columns) + 0.8, (_MAP_INCHES + 0.25) * len(sparse) + 0.7)
    figure = Figure(figsize=size, layout="constrained")
    if title:
        figure.suptitle(title, fontsize=_LARGE, parse_math=False)
    axes = figure.subplots(len(sparse), len(columns), squeeze=False)
    for place, (name, maps) in enumerate(columns.items()):
        for axis, values in zip(axes[:, place], maps, strict=True):
            image = axis.imshow(values, vmin=0, vmax=1, cmap="viridis", interpolation="nearest")
            _finish(axis, len(values), grid)
        axes[-1, place].set_xlabel(name, fontsize=_SMALL)
    places = [""] * len(sparse) if pixels is None else [f"row {row}, column {col}: " for row, col in pixels]
    for axis, place_in_image, error in zip(axes[:, 0], places, error_deg, strict=True):
        axis.set_title(f"{place_in_image}{error:.1f} deg off", fontsize=_SMALL, loc="left")
    bar = figure.colorbar(image, ax=axes, shrink=min(1, 2 / len(sparse)), aspect=25)
    bar.set_label("relative to the largest observation", fontsize=_SMALL)
    bar.ax.tick_params(labelsize=_SMALL)
    return png_bytes(figure, _DPI)


def _finish(axes: Axes, size: int, grid: Grid) -> None:
    from matplotlib.patches import Circle

    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor(_EMPTY)
    # In matplotlib, cell k reaches from k - 1/2 to k + 1/2. In the authors' grid, the last column and the top row
    # stand for a single line each.
    centre, radius = (size / 2 - 0.5, size / 2 - 0.5), size / 2
    if grid == "cnn-ps":
        centre, radius = (size / 2 - 1, size / 2), (size - 1) / 2
    axes.add_patch(Circle(centre, radius, fill=False, edgecolor="black", linewidth=0.8, clip_on=False))
