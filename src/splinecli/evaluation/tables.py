"""Evaluations as tables for people: Markdown, LaTeX, and rows for a terminal.

All functions take one evaluation, or several of the same methods that differ in n_lights, light_noise_deg or both.
"""

import re
from collections.abc import Callable, Sequence

from splinecli.errors import printable
from splinecli.evaluation.protocol import Evaluation, heading, protocol_in_words
from splinecli.evaluation.statistics import AVERAGE

_MOST_WIDE = 6  # captures: with more, the table is set in small type, so that DiLiGenT's ten fit on a page
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


def table_rows(evaluation: Evaluation) -> list[list[str]]:
    """Return a header row, then a row for each method: name, MAE on each capture, average; two decimals."""
    mae_deg = {(result.method, result.capture): result.mae_deg for result in evaluation.results}
    rows = [["method", *(printable(name) for name in evaluation.captures), AVERAGE]]
    for method, average in evaluation.averages.items():
        values = [*(mae_deg[method, capture] for capture in evaluation.captures), average]
        rows.append([method, *(f"{value:.2f}" for value in values)])
    return rows


def best_cells(rows: Sequence[Sequence[str]]) -> set[tuple[int, int]]:
    """Return the (row, column) of the smallest printed values of each column; none where there is one method."""
    best = set()
    if len(rows) > 2:
        for column in range(1, len(rows[0])):
            smallest = min(float(row[column]) for row in rows[1:])
            best |= {(i, column) for i, row in enumerate(rows) if i and float(row[column]) == smallest}
    return best


def caption(evaluation: Evaluation) -> str:
    """Return what a table shows, with the protocol: "Mean angular error in degrees: 10 lights, ..."."""
    return f"Mean angular error in degrees: {protocol_in_words(evaluation.protocol)}."


def markdown(evaluations: Sequence[Evaluation]) -> str:
    """Return a Markdown table of methods by captures and their average, with a caption below it.

    The best value of each column is bold. With several evaluations, each has its table under a heading.
    """
    tables = []
    for evaluation in evaluations:
        rows = _marked_rows(evaluation, _escape_markdown, "**{}**")
        lines = ["| " + " | ".join(row) + " |" for row in rows]
        lines.insert(1, "|---|" + "---:|" * (len(rows[0]) - 1))
        title = [f"## {heading(evaluation.protocol)}", ""] if len(evaluations) > 1 else []
        tables.append("\n".join([*title, *lines, "", _escape_markdown(caption(evaluation))]) + "\n")
    return "\n".join(tables)


def latex(evaluations: Sequence[Evaluation]) -> str:
    """Return a floating table for each evaluation, for a document that loads booktabs.

    table* spans both columns of a paper that has two.
    """
    needs = "% Needs \\usepackage{booktabs} in the preamble.\n"
    return needs + "\n".join(_latex_table(evaluation) for evaluation in evaluations)


def _escape_markdown(text: str) -> str:
    """Return text of one line that Markdown shows as it is."""
    return re.sub(r"([\\`*<>|\[\]&~])", r"\\\1", " ".join(text.split()))


def _latex_table(evaluation: Evaluation) -> str:
    head, *rows = (" & ".join(row) + r" \\" for row in _marked_rows(evaluation, _escape_latex, r"\textbf{{{}}}"))
    best = " The best of each column in bold." if len(rows) > 1 else ""
    narrow = [r"  \footnotesize\setlength{\tabcolsep}{2pt}"] if len(evaluation.captures) > _MOST_WIDE else []
    lines = [
        r"\begin{table*}",
        r"  \centering",
        rf"  \caption{{{_escape_latex(caption(evaluation))}{best}}}",
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
    """Return table_rows with the best cells in a template for bold text."""
    rows = table_rows(evaluation)
    best = best_cells(rows)
    return [
        [bold.format(escape(cell)) if (r, c) in best else escape(cell) for c, cell in enumerate(row)]
        for r, row in enumerate(rows)
    ]


def _escape_latex(text: str) -> str:
    return text.translate(_LATEX)
