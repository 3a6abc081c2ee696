"""The files that an evaluation writes, and its data for results.json and results.csv.

All functions take one evaluation, or several of the same methods that differ in n_lights, light_noise_deg or both.
"""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splinecli import __version__
from splinecli.capture.result_names import LIGHT_NOISE_PLOT, LIGHT_PLOT
from splinecli.errors import printable
from splinecli.evaluation.capture_figures import CaptureFigure
from splinecli.evaluation.error_plots import light_noise_curves, lights_curves
from splinecli.evaluation.protocol import Evaluation, Protocol, all_skipped, lights_value
from splinecli.evaluation.report import html_report
from splinecli.evaluation.statistics import compare
from splinecli.evaluation.tables import latex, markdown
from splinecli.system.publishing import new_files

SCHEMA = 1  # Schema version of results.json. It rises when a field changes its meaning.
_DIGITS = 4  # behind the point, of degrees and seconds
_P_DIGITS = 3  # significant ones: p-values span many orders of magnitude
_FORMULA = ("=", "+", "-", "@")

TRIALS, REPORT, RESULTS, FIGURES = "trials.jsonl", "report.html", "results.json", "figures"


def _make_plots(evaluations: Sequence[Evaluation]) -> dict[str, tuple[str, bytes]]:
    """Return plots of the error against what the evaluations differ in: captions and PNGs by the names of files."""
    plots: dict[str, tuple[str, bytes]] = {}
    if not set.intersection(*(set(evaluation.captures) for evaluation in evaluations)):
        return plots
    if len({evaluation.protocol.n_lights for evaluation in evaluations}) > 1:
        plots[LIGHT_PLOT] = ("Error against the number of lights.", lights_curves(evaluations))
    if len({evaluation.protocol.light_noise_deg for evaluation in evaluations}) > 1:
        plots[LIGHT_NOISE_PLOT] = ("Error against the light noise.", light_noise_curves(evaluations))
    return plots


def write_results(
    output: Path, evaluations: Sequence[Evaluation], figures: Sequence[CaptureFigure] | None
) -> dict[str, Any]:
    """Write all files in place of those of an earlier evaluation (see new_files). The caller holds the folder.

    Without `figures`, those of an earlier evaluation stay. Returns the content of results.json.
    """
    document, plots = results_document(evaluations), _make_plots(evaluations)
    shown = [*plots.values(), *((figure.caption, figure.png) for figure in figures or ())]
    texts = {
        "results.csv": results_csv(evaluations),
        "table.md": markdown(evaluations),
        "table.tex": latex(evaluations),
        REPORT: html_report(evaluations, shown, document["notes"]),
        RESULTS: json.dumps(document, indent=2) + "\n",
    }
    stale = [LIGHT_PLOT, LIGHT_NOISE_PLOT]
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


def results_document(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """Return the content of results.json. Degrees and seconds have four decimals.

    With several evaluations, `protocol` lists the values in which they differ, and `averages` has an entry for each
    evaluation under each method, by the same values: {"ls": {"10": 16.1, "all": 15.4}}. p-values have three
    significant digits.
    """
    return {
        "schema": SCHEMA,
        "protocol": _protocol_record([evaluation.protocol for evaluation in evaluations]),
        "methods": {name: dict(settings) for name, settings in evaluations[0].settings.items()},
        "results": [
            {**record, "maes_deg": [_rounded(mae_deg) for mae_deg in result.maes_deg]}
            for record, result in zip(_records(evaluations), (r for e in evaluations for r in e.results), strict=True)
        ],
        "averages": _averages(evaluations),
        "comparisons": [record for evaluation in evaluations for record in _comparisons(evaluation)],
        "skipped": [{"capture": s.capture, "reason": s.reason} for s in all_skipped(evaluations)],
        "notes": list(dict.fromkeys(note for evaluation in evaluations for note in evaluation.notes)),
        "version": __version__,
    }


def _comparisons(evaluation: Evaluation) -> list[dict[str, Any]]:
    return [
        {
            "first": c.first,
            "second": c.second,
            "capture": c.capture,
            "n_lights": lights_value(evaluation.protocol),
            "light_noise_deg": evaluation.protocol.light_noise_deg,
            "trials": c.trials,
            "difference_deg": _rounded(c.difference_deg),
            "std_deg": _rounded(c.std_deg),
            "interval_deg": None if c.interval_deg is None else [_rounded(end_deg) for end_deg in c.interval_deg],
            "p_value": _significant(c.p_value),
            "p_holm": _significant(c.p_holm),
            "differs": c.differs,
        }
        for c in compare(evaluation)
    ]


def results_csv(evaluations: Sequence[Evaluation]) -> str:
    """Return a header and a line for each result, with the names and values of `results` in results.json."""
    text = io.StringIO()
    records = _records(evaluations)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(records[0])
    writer.writerows(map(_as_text_cell, record.values()) for record in records)
    return text.getvalue()


def _as_text_cell(value: Any) -> Any:
    """Return a value as a cell of one line that no spreadsheet takes for a formula: an apostrophe marks it as text."""
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text


def _protocol_record(protocols: Sequence[Protocol]) -> dict[str, Any]:
    first = protocols[0]
    return {
        "n_lights": _one_or_list([lights_value(protocol) for protocol in protocols]),
        "trials": first.trials,
        "seed": first.seed,
        "draws": None if first.draws_file is None else first.draws_file.name,
        "light_noise_deg": _one_or_list([protocol.light_noise_deg for protocol in protocols]),
        "max_pixels": first.max_pixels,
        "skip_first": dict(first.skip_first),
        "as_stored": first.as_stored,
        "white_level": first.white_level,
        "light_error_deg": first.light_error_deg,
        "lights_estimated": first.finds_lights,
    }


def _records(evaluations: Sequence[Evaluation]) -> list[dict[str, Any]]:
    return [
        {
            "method": result.method,
            "capture": result.capture,
            "n_lights": result.n_lights,
            "light_noise_deg": evaluation.protocol.light_noise_deg,
            "mae_deg": _rounded(result.mae_deg),
            "std_deg": _rounded(result.std_deg),
            "trials": result.trials,
            "seconds": _rounded(result.seconds),
            "as_stored": evaluation.protocol.as_stored,
            "found_light_error_deg": _rounded(result.found_light_error_deg),
        }
        for evaluation in evaluations
        for result in evaluation.results
    ]


def _averages(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    averages = [{method: _rounded(value) for method, value in e.averages.items()} for e in evaluations]
    if len(evaluations) == 1:
        return dict(averages[0])
    # The values in which the evaluations differ: "10", "all"; "0", "2.5"; or both, "10, 2.5".
    lights = [str(lights_value(e.protocol)) for e in evaluations]
    noise = [f"{e.protocol.light_noise_deg:g}" for e in evaluations]
    differing = [values for values in (lights, noise) if len(set(values)) > 1] or [lights]
    keys = [", ".join(values) for values in zip(*differing, strict=True)]
    methods = dict.fromkeys(method for average in averages for method in average)
    return {method: {key: average[method] for key, average in zip(keys, averages, strict=True)} for method in methods}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DIGITS)


def _significant(p_value: float | None) -> float | None:
    return None if p_value is None else float(f"{p_value:.{_P_DIGITS}g}")


def _one_or_list(values: Sequence[Any]) -> Any:
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else different
