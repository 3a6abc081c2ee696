"""The files that an evaluation writes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splinecli.evaluation.capture_figures import CaptureFigure
from splinecli.evaluation.document import results_csv, results_document
from splinecli.evaluation.error_plots import light_noise_curves, lights_curves
from splinecli.evaluation.outcome import Evaluation
from splinecli.evaluation.report import html_report
from splinecli.evaluation.tables import latex, markdown
from splinecli.files import refusals_as_output_errors, write_bytes, write_text

TRIALS, REPORT, FIGURES = "trials.jsonl", "report.html", "figures"
LIGHTS_PLOT, LIGHT_NOISE_PLOT = "lights.png", "light_noise.png"

Plots = Mapping[str, tuple[str, bytes]]
"""A caption and a PNG by the name of the file."""


def make_plots(evaluations: Sequence[Evaluation]) -> Plots:
    """Return the plots of the error against what the evaluations differ in; none where nothing differs."""
    plots: dict[str, tuple[str, bytes]] = {}
    if not set.intersection(*(set(evaluation.captures) for evaluation in evaluations)):
        return plots
    if len({evaluation.protocol.n_lights for evaluation in evaluations}) > 1:
        plots[LIGHTS_PLOT] = ("Error against the number of lights.", lights_curves(evaluations))
    if len({evaluation.protocol.light_noise_deg for evaluation in evaluations}) > 1:
        plots[LIGHT_NOISE_PLOT] = ("Error against the light noise.", light_noise_curves(evaluations))
    return plots


def write_results(output: Path, evaluations: Sequence[Evaluation], plots: Plots) -> dict[str, Any]:
    """Write all files except the figures, and delete plots of an earlier evaluation.

    Returns:
        The content of results.json.
    """
    document = results_document(evaluations)
    write_text(output / "results.csv", results_csv(evaluations))
    write_text(output / "table.md", markdown(evaluations))
    write_text(output / "table.tex", latex(evaluations))
    for name in (LIGHTS_PLOT, LIGHT_NOISE_PLOT):
        if name in plots:
            write_bytes(output / name, plots[name][1])
        else:
            with refusals_as_output_errors(output / name):
                (output / name).unlink(missing_ok=True)
    write_text(output / REPORT, html_report(evaluations, list(plots.values()), document["notes"]))
    write_text(output / "results.json", json.dumps(document, indent=2) + "\n")
    return document


def write_figures(
    output: Path, evaluations: Sequence[Evaluation], plots: Plots, figures: Sequence[CaptureFigure]
) -> None:
    """Write the figures and the report that shows them, and delete figures of an earlier evaluation."""
    folder = output / FIGURES
    names = {f"{figure.stem}.png" for figure in figures}
    with refusals_as_output_errors(folder):
        for path in folder.glob("*.png"):
            if path.name not in names:
                path.unlink()
    for figure in figures:
        write_bytes(folder / f"{figure.stem}.png", figure.png)
    shown = [*plots.values(), *((figure.caption, figure.png) for figure in figures)]
    notes = results_document(evaluations)["notes"]
    write_text(output / REPORT, html_report(evaluations, shown, notes))
