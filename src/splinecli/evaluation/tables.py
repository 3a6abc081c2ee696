"""Evaluations as documents: results.json, results.csv, Markdown, LaTeX, and rows for a terminal.

All take one evaluation, or several of the same methods that differ in n_lights, light_noise_deg or both.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Sequence
from typing import Any

from splinecli import __version__
from splinecli.evaluation.records import Evaluation, Protocol
from splinecli.evaluation.statistics import AVERAGE, compare

_DEGREE_DIGITS, _SECOND_DIGITS = 4, 4
_P_DIGITS = 3  # significant ones: p-values span many orders of magnitude
_COLUMNS = ("method", "capture", "n_lights", "light_noise_deg", "mae_deg", "std_deg", "trials", "seconds")

_MOST_WIDE = 6  # captures: more fit a page of article, the ten of DiLiGenT among them, in small type
_LATEX = str.maketrans(
    {
        **{character: f"\\{character}" for character in "&%$#_{}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        # In TeX's oldest font encoding, still the default, these are other characters.
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
    }
)


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
            "skip_first": dict(first.skip_first),
        },
        "methods": {name: dict(settings) for name, settings in evaluations[0].settings.items()},
        "results": [
            {**record, "maes_deg": [round(mae_deg, _DEGREE_DIGITS) for mae_deg in result.maes_deg]}
            for record, result in zip(
                _records(evaluations), (r for e in evaluations for r in e.results), strict=True
            )
        ],
        "averages": _averages(evaluations),
        "comparisons": comparison_records(evaluations),
        "skipped": [
            {"capture": capture, "reason": reason}
            for capture, reason in dict.fromkeys(
                (s.capture, s.reason) for e in evaluations for s in e.skipped
            )
        ],
        "notes": list(dict.fromkeys(note for e in evaluations for note in e.notes)),
        "version": __version__,
    }


def comparison_records(evaluations: Sequence[Evaluation]) -> list[dict[str, Any]]:
    """`comparisons` in results.json: statistics.compare of each evaluation, p-values with three significant digits.

    n_lights is as asked for, a number or "all".
    """
    return [
        {
            "first": c.first,
            "second": c.second,
            "capture": c.capture,
            "n_lights": _lights(evaluation.protocol),
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


def latex(evaluations: Sequence[Evaluation]) -> str:
    """A floating table for each evaluation, as markdown has them, for a document that loads booktabs.

    The caption tells the protocol. table* spans both columns of a paper that has two.
    """
    needs = "% Needs \\usepackage{booktabs} in the preamble.\n"
    return needs + "\n".join(_latex_table(evaluation) for evaluation in evaluations)


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
    return lights_in_words(protocol) + noise


def lights_in_words(protocol: Protocol) -> str:
    """The lights of a draw: "10 lights", "all lights"."""
    return f"{_lights(protocol)} lights"


def protocol_in_words(protocol: Protocol) -> str:
    """How the lights, trials and pixels were chosen: "10 lights, 20 random draws, seed 0"."""
    parts = [heading(protocol)]
    if protocol.draws_file is not None:
        parts.append(f"the {protocol.trials} draws of {protocol.draws_file.name}")
    elif protocol.n_lights is not None:
        parts.append(f"{protocol.trials} random {'draw' if protocol.trials == 1 else 'draws'}")
    elif protocol.light_noise_deg:  # all lights without noise are one trial, however many were asked for
        parts.append(f"{protocol.trials} {'trial' if protocol.trials == 1 else 'trials'}")
    parts.append(f"seed {protocol.seed}")
    if protocol.max_pixels is not None:
        parts.append(f"at most {protocol.max_pixels} pixels of each capture")
    return ", ".join(parts)


def _markdown_table(evaluation: Evaluation) -> str:
    rows = _marked_rows(evaluation, _escape_markdown, "**{}**")
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---|" + "---:|" * (len(rows[0]) - 1))
    return "\n".join(lines) + "\n"


def _escape_markdown(text: str) -> str:
    """Text of one line that Markdown shows as it is."""
    return re.sub(r"([\\`*<>|])", r"\\\1", " ".join(text.split()))


def _latex_table(evaluation: Evaluation) -> str:
    head, *rows = (
        " & ".join(row) + r" \\" for row in _marked_rows(evaluation, _escape_latex, r"\textbf{{{}}}")
    )
    protocol = _escape_latex(protocol_in_words(evaluation.protocol))
    best = " The best of each column in bold." if len(rows) > 1 else ""
    narrow = [r"  \footnotesize\setlength{\tabcolsep}{2pt}"] if len(evaluation.captures) > _MOST_WIDE else []
    lines = [
        r"\begin{table*}",
        r"  \centering",
        rf"  \caption{{Mean angular error in degrees: {protocol}.{best}}}",
        *narrow,
        rf"  \begin{{tabular}}{{l{'r' * (len(evaluation.captures) + 1)}}}",
        r"    \toprule",
        f"    {head}",
        r"    \midrule",
        *(f"    {row}" for row in rows),
        r"    \bottomrule",
        r"  \end{tabular}",
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def _marked_rows(evaluation: Evaluation, escape: Callable[[str], str], bold: str) -> list[list[str]]:
    """table_rows with the best cells in a template for bold text."""
    rows = table_rows(evaluation)
    best = best_cells(rows)
    return [
        [bold.format(escape(cell)) if (r, c) in best else escape(cell) for c, cell in enumerate(row)]
        for r, row in enumerate(rows)
    ]


def _escape_latex(text: str) -> str:
    return text.translate(_LATEX)


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


def _significant(p_value: float | None) -> float | None:
    return None if p_value is None else float(f"{p_value:.{_P_DIGITS}g}")


def _one_or_list(values: Sequence[Any]) -> Any:
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else different
