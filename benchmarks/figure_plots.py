"""Draw the plots of the documentation from docs/figures.json.

    python benchmarks/figure_plots.py

It writes docs/pictures/accuracy_*.svg: errors against the number of lights and against the noise of
the light directions, and beside published methods.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from figure_tables import FIGURES, LIGHTS, NOISE_DEG, OBJECTS, PUBLISHED, Measured

PICTURES = FIGURES.parent / "pictures"
COLOURS = {
    "ls": "#888888",
    "iw12": "#c98a1b",
    "ia14": "#3c8c40",
    "spline-net-pixelwise": "#7986cb",
    "spline-net": "#1a237e",
}
# the same file each time, with text as text
STYLE = {
    "svg.hashsalt": "splinecli",
    "svg.fonttype": "none",
}


def over_lights(measured: Measured) -> Figure:
    """Return a plot of the mean error of the three objects over the number of lights."""
    cells = {count: measured[f"lights-{count}"]["rows"] for count in LIGHTS}
    means = {
        method: [
            sum(cells[count][method][f"{label} {count}"] for label in OBJECTS) / len(OBJECTS)
            for count in LIGHTS
        ]
        for method in COLOURS
    }
    figure = curves(LIGHTS, means, "number of lights")
    axes = figure.axes[0]
    axes.set_xscale("log")
    axes.set_xticks(LIGHTS, [str(count) for count in LIGHTS])
    axes.minorticks_off()
    return figure


def over_noise(measured: Measured) -> Figure:
    """Return a plot of the mean error of the three objects over the noise of the light
    directions.
    """
    sigmas = (0.0, *NOISE_DEG)
    rows = measured["noise"]["rows"]
    errors = {method: [rows[method][f"{sigma:g}"] for sigma in sigmas] for method in COLOURS}
    return curves(sigmas, errors, "sigma of the light directions in degrees")


def beside_published(measured: Measured) -> Figure:
    """Return a plot of the errors on each object under ten lights,
    for published methods and ours.
    """
    ours = {f"{name} (ours)": measured["lights-10"]["rows"][name] for name in ("ls", "spline-net")}
    columns = [f"{label} 10" for label in OBJECTS]
    rows = {**measured[PUBLISHED]["rows"], **ours}
    rows = {name: cells for name, cells in rows.items() if set(columns) <= cells.keys()}
    figure = Figure(figsize=(8, 2.6), layout="constrained")
    colours = [COLOURS["spline-net" if name == "spline-net (ours)" else "ls"] for name in rows]
    panels = figure.subplots(1, len(columns), sharey=True)
    for axes, title, column in zip(panels, OBJECTS, columns, strict=True):
        errors = [cells[column] for cells in rows.values()]
        axes.bar_label(axes.barh(list(rows), errors, color=colours), fmt="%.1f", padding=3)
        axes.set_title(title)
        axes.set_xticks([])
        axes.margins(x=0.2)
        axes.tick_params(left=False)
        axes.spines[["top", "right", "bottom"]].set_visible(False)
    panels[0].invert_yaxis()
    figure.supxlabel("mean angular error in degrees")
    return figure


def curves(x: Sequence[float], y: Mapping[str, Sequence[float]], label: str) -> Figure:
    figure = empty_figure(label)
    for method, errors in y.items():
        figure.axes[0].plot(x, errors, "o-", color=COLOURS[method], label=method)
    figure.axes[0].set_ylim(bottom=0)
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


def empty_figure(label: str) -> Figure:
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel(label)
    axes.set_ylabel("mean angular error in degrees")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


PLOTS = {
    "accuracy_lights.svg": over_lights,
    "accuracy_noise.svg": over_noise,
    "accuracy_published.svg": beside_published,
}


def main(folder: Path = PICTURES) -> None:
    measured = json.loads(FIGURES.read_text("utf-8"))
    with matplotlib.rc_context(STYLE):
        for name, plot in PLOTS.items():
            plot(measured).savefig(folder / name, metadata={"Date": None}, facecolor="white")


if __name__ == "__main__":
    main()
