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
from splinecli.system.publishing import new_files

TRIALS, REPORT, RESULTS, FIGURES = "trials.jsonl", "report.html", "results.json", "figures"
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


def write_results(
    output: Path, evaluations: Sequence[Evaluation], plots: Plots, figures: Sequence[CaptureFigure] | None
) -> dict[str, Any]:
    """Write all files in place of those of an earlier evaluation (see new_files). The caller holds the folder.

    Args:
        figures: None leaves the figures of an earlier evaluation.

    Returns:
        The content of results.json.
    """
    document = results_document(evaluations)
    shown = [*plots.values(), *((figure.caption, figure.png) for figure in figures or ())]
    texts = {
        "results.csv": results_csv(evaluations),
        "table.md": markdown(evaluations),
        "table.tex": latex(evaluations),
        REPORT: html_report(evaluations, shown, document["notes"]),
        RESULTS: json.dumps(document, indent=2) + "\n",
    }
    stale = [LIGHTS_PLOT, LIGHT_NOISE_PLOT]
    if figures is not None:
        stale += [f"{FIGURES}/{path.name}" for path in (output / FIGURES).glob("*.png")]
    with new_files(output, report=RESULTS, stale=stale) as new:
        for name, text in texts.items():
            new.write(name, text)
        for name, (_, png) in plots.items():
            new.write(name, png)
        for figure in figures or ():
            new.write(f"{FIGURES}/{figure.stem}.png", figure.png)
    return document
