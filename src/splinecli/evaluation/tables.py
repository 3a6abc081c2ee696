"""Evaluations as documents: results.json, results.csv, Markdown, and rows for a terminal.

All take one evaluation, or several of the same methods that differ in n_lights, light_noise_deg or both.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from splinecli import __version__
from splinecli.evaluation.records import Evaluation, Protocol

AVERAGE = "average"

_DEGREE_DIGITS, _SECOND_DIGITS = 4, 4
_COLUMNS = ("method", "capture", "n_lights", "light_noise_deg", "mae_deg", "std_deg", "trials", "seconds")


def results_document(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """The content of results.json; degrees and seconds have four decimals.

    Of several evaluations, `protocol` lists the values in which they differ, and `averages` has for each
    method one entry an evaluation, by the same values: {"ls": {"10": 16.1, "all": 15.4}}.
    """
    protocols = [evaluation.protocol for evaluation in evaluations]
    first = protocols[0]
    return {
        "protocol": {
            "n_lights": _one_or_list([_lights(protocol) for protocol in protocols]),
            "trials": first.trials,
            "seed": first.seed,
            "draws": None if first.draws_file is None else first.draws_file.name,
            "light_noise_deg": _one_or_list([protocol.light_noise_deg for protocol in protocols]),
            "max_pixels": first.max_pixels,
        },
        "results": _records(evaluations),
        "averages": _averages(evaluations),
        "skipped": [
            {"capture": capture, "reason": reason}
            for capture, reason in dict.fromkeys(
                (s.capture, s.reason) for e in evaluations for s in e.skipped
            )
        ],
        "version": __version__,
    }


def results_csv(evaluations: Sequence[Evaluation]) -> str:
    """A header and a line for each result; the names and values are those of `results` in results.json."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(_records(evaluations))
    return text.getvalue()


def markdown(evaluations: Sequence[Evaluation]) -> str:
    """Methods by captures with the average: mean angular errors in degrees, the best of each column in bold.

    Of several evaluations, a table each under a heading.
    """
    tables = [_markdown_table(evaluation) for evaluation in evaluations]
    if len(evaluations) > 1:
        titles = [heading(evaluation.protocol) for evaluation in evaluations]
        tables = [f"## {title}\n\n{table}" for title, table in zip(titles, tables, strict=True)]
    return "\n".join(tables)


def table_rows(evaluation: Evaluation) -> list[list[str]]:
    """A header row, then a row for each method: name, MAE on each capture, average; two decimals."""
    mae_deg = {(result.method, result.capture): result.mae_deg for result in evaluation.results}
    rows = [["method", *evaluation.captures, AVERAGE]]
    for method, average in evaluation.averages.items():
        values = [*(mae_deg[method, capture] for capture in evaluation.captures), average]
        rows.append([method, *(f"{value:.2f}" for value in values)])
    return rows


def best_cells(rows: Sequence[Sequence[str]]) -> set[tuple[int, int]]:
    """The (row, column) of each column's smallest values as printed; none where there is one method only."""
    best = set()
    if len(rows) > 2:
        for column in range(1, len(rows[0])):
            smallest = min(float(row[column]) for row in rows[1:])
            best |= {(i, column) for i, row in enumerate(rows) if i and float(row[column]) == smallest}
    return best


def heading(protocol: Protocol) -> str:
    """What tells an evaluation from its neighbours: "10 lights", "all lights, light noise of 2 degrees"."""
    noise = f", light noise of {protocol.light_noise_deg:g} degrees" if protocol.light_noise_deg else ""
    return f"{_lights(protocol)} lights{noise}"


def _markdown_table(evaluation: Evaluation) -> str:
    rows = table_rows(evaluation)
    for row, column in best_cells(rows):
        rows[row][column] = f"**{rows[row][column]}**"
    lines = ["| " + " | ".join(cell.replace("|", r"\|") for cell in row) + " |" for row in rows]
    lines.insert(1, "|---|" + "---:|" * (len(rows[0]) - 1))
    return "\n".join(lines) + "\n"


def _records(evaluations: Sequence[Evaluation]) -> list[dict[str, Any]]:
    records = []
    for evaluation in evaluations:
        for result in evaluation.results:
            values = (
                result.method,
                result.capture,
                result.n_lights,
                evaluation.protocol.light_noise_deg,
                round(result.mae_deg, _DEGREE_DIGITS),
                round(result.std_deg, _DEGREE_DIGITS),
                result.trials,
                round(result.seconds, _SECOND_DIGITS),
            )
            records.append(dict(zip(_COLUMNS, values, strict=True)))
    return records


def _averages(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    averages = [
        {method: round(value, _DEGREE_DIGITS) for method, value in evaluation.averages.items()}
        for evaluation in evaluations
    ]
    if len(evaluations) == 1:
        return dict(averages[0])
    keys = _keys([evaluation.protocol for evaluation in evaluations])
    methods = dict.fromkeys(method for average in averages for method in average)
    return {
        method: {key: average[method] for key, average in zip(keys, averages, strict=True)}
        for method in methods
    }


def _keys(protocols: Sequence[Protocol]) -> list[str]:
    """The values in which protocols differ, as text: "10", "all"; "0", "2.5"; or both, "10, 2.5"."""
    lights = [str(_lights(protocol)) for protocol in protocols]
    noise = [f"{protocol.light_noise_deg:g}" for protocol in protocols]
    differing = [values for values in (lights, noise) if len(set(values)) > 1] or [lights]
    return [", ".join(values) for values in zip(*differing, strict=True)]


def _lights(protocol: Protocol) -> int | str:
    return "all" if protocol.n_lights is None else protocol.n_lights


def _one_or_list(values: Sequence[Any]) -> Any:
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else different
