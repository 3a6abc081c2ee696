"""Evaluations as data: results.json and results.csv.

All functions take one evaluation, or several of the same methods that differ in n_lights, light_noise_deg or both.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from splinecli import __version__
from splinecli.errors import printable
from splinecli.evaluation.outcome import Evaluation, all_notes, all_skipped
from splinecli.evaluation.protocol import Protocol, lights_value
from splinecli.evaluation.statistics import compare

SCHEMA = 1
"""Schema version of results.json. It rises when a field changes its meaning."""

_DEGREE_DIGITS, _SECOND_DIGITS = 4, 4
_P_DIGITS = 3  # significant ones: p-values span many orders of magnitude
_FORMULA = ("=", "+", "-", "@")


def results_document(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """Return the content of results.json. Degrees and seconds have four decimals.

    With several evaluations, `protocol` lists the values in which they differ, and `averages` has an entry for each
    evaluation under each method, by the same values: {"ls": {"10": 16.1, "all": 15.4}}.
    """
    return {
        "schema": SCHEMA,
        "protocol": _protocol_record([evaluation.protocol for evaluation in evaluations]),
        "methods": {name: dict(settings) for name, settings in evaluations[0].settings.items()},
        "results": [
            {**record, "maes_deg": [round(mae_deg, _DEGREE_DIGITS) for mae_deg in result.maes_deg]}
            for record, result in zip(_records(evaluations), (r for e in evaluations for r in e.results), strict=True)
        ],
        "averages": _averages(evaluations),
        "comparisons": comparison_records(evaluations),
        "skipped": [{"capture": s.capture, "reason": s.reason} for s in all_skipped(evaluations)],
        "notes": all_notes(evaluations),
        "version": __version__,
    }


def comparison_records(evaluations: Sequence[Evaluation]) -> list[dict[str, Any]]:
    """Return `comparisons` of results.json: statistics.compare of each evaluation.

    p-values have three significant digits. n_lights is a number or "all", as in the protocol.
    """
    return [
        {
            "first": c.first,
            "second": c.second,
            "capture": c.capture,
            "n_lights": lights_value(evaluation.protocol),
            "light_noise_deg": evaluation.protocol.light_noise_deg,
            "trials": c.trials,
            "difference_deg": round(c.difference_deg, _DEGREE_DIGITS),
            "std_deg": round(c.std_deg, _DEGREE_DIGITS),
            "interval_deg": None
            if c.interval_deg is None
            else [round(end_deg, _DEGREE_DIGITS) for end_deg in c.interval_deg],
            "p_value": _significant(c.p_value),
            "p_holm": _significant(c.p_holm),
            "differs": c.differs,
        }
        for evaluation in evaluations
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
            "mae_deg": round(result.mae_deg, _DEGREE_DIGITS),
            "std_deg": round(result.std_deg, _DEGREE_DIGITS),
            "trials": result.trials,
            "seconds": round(result.seconds, _SECOND_DIGITS),
            "as_stored": evaluation.protocol.as_stored,
            "found_light_error_deg": None
            if result.found_light_error_deg is None
            else round(result.found_light_error_deg, _DEGREE_DIGITS),
        }
        for evaluation in evaluations
        for result in evaluation.results
    ]


def _averages(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    averages = [
        {method: round(value, _DEGREE_DIGITS) for method, value in evaluation.averages.items()}
        for evaluation in evaluations
    ]
    if len(evaluations) == 1:
        return dict(averages[0])
    keys = _keys([evaluation.protocol for evaluation in evaluations])
    methods = dict.fromkeys(method for average in averages for method in average)
    return {method: {key: average[method] for key, average in zip(keys, averages, strict=True)} for method in methods}


def _keys(protocols: Sequence[Protocol]) -> list[str]:
    """Return the values in which protocols differ as text: "10", "all"; "0", "2.5"; or both, "10, 2.5"."""
    lights = [str(lights_value(protocol)) for protocol in protocols]
    noise = [f"{protocol.light_noise_deg:g}" for protocol in protocols]
    differing = [values for values in (lights, noise) if len(set(values)) > 1] or [lights]
    return [", ".join(values) for values in zip(*differing, strict=True)]


def _significant(p_value: float | None) -> float | None:
    return None if p_value is None else float(f"{p_value:.{_P_DIGITS}g}")


def _one_or_list(values: Sequence[Any]) -> Any:
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else different
