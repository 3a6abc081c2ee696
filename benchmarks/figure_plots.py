"""Draw the plots of the documentation from docs/figures.json.

    python benchmarks/figure_plots.py

It writes docs/pictures/accuracy_*.svg: errors against the number of lights and against the noise of the light
directions, and beside published methods.
"""

import json
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from figure_tables import FIGURES, LIGHTS, NOISE_DEG, OBJECTS, PUBLISHED, Measured

PICTURES = FIGURES.parent / "pictures"
METHODS = ("ls", "iw12", "ia14", "spline-net-pixelwise", "spline-net")
COLOURS = dict(zip(METHODS, ("#888888", "#c98a1b", "#3c8c40", "#7986cb", "#1a237e"), strict=True))


def over_lights(measured: Measured) -> None:
    """Draw the mean error of the three objects over the number of lights."""
    _, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for method in METHODS:
        means = []
        for count in LIGHTS:
            cells = measured[f"lights-{count}"]["rows"][method]
            means.append(sum(cells[f"{label} {count}"] for label in OBJECTS) / len(OBJECTS))
        axes.plot(LIGHTS, means, "o-", color=COLOURS[method], label=method)
    axes.set_xscale("log")
    axes.set_xticks(LIGHTS, [str(count) for count in LIGHTS])
    axes.minorticks_off()
    finish(axes, "number of lights")
    save("accuracy_lights.svg")


def over_noise(measured: Measured) -> None:
    """Draw the mean error of the three objects over the noise of the light directions."""
    _, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    sigmas = (0.0, *NOISE_DEG)
    for method in METHODS:
        cells = measured["noise"]["rows"][method]
        axes.plot(sigmas, [cells[f"{sigma:g}"] for sigma in sigmas], "o-", color=COLOURS[method], label=method)
    finish(axes, "sigma of the light directions in degrees")
    save("accuracy_noise.svg")


def beside_published(measured: Measured) -> None:
    """Draw the errors on each object under ten lights, beside published ones."""
    published = {name: cells for name, cells in measured[PUBLISHED]["rows"].items() if "Reading 10" in cells}
    ours = {f"{name} (ours)": measured["lights-10"]["rows"][name] for name in ("ls", "spline-net")}
    labels = list(OBJECTS)
    rows = {name: cells for name, cells in {**published, **ours}.items() if all(f"{o} 10" in cells for o in labels)}
    _, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    width = 0.8 / len(rows)
    for k, (name, cells) in enumerate(rows.items()):
        colour = "#1a237e" if name.startswith("spline-net") else plt.get_cmap("Greys")(0.25 + 0.5 * k / len(rows))
        heights = [cells[f"{label} 10"] for label in labels]
        axes.bar(
            [x + (k - (len(rows) - 1) / 2) * width for x in range(len(labels))],
            heights,
            width,
            color=colour,
            label=name,
        )
    axes.set_xticks(range(len(labels)), labels)
    finish(axes, "")
    save("accuracy_published.svg")


def finish(axes: Axes, text: str) -> None:
    axes.set_xlabel(text)
    axes.set_ylabel("mean angular error in degrees")
    axes.set_ylim(bottom=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize="small")


def save(name: str) -> None:
    plt.savefig(PICTURES / name, metadata={"Date": None}, facecolor="white")
    plt.close()


def main() -> None:
    plt.rcParams["svg.hashsalt"] = "splinecli"
    plt.rcParams["svg.fonttype"] = "none"
    measured = json.loads(Path(FIGURES).read_text("utf-8"))
    over_lights(measured)
    over_noise(measured)
    beside_published(measured)


if __name__ == "__main__":
    main()
