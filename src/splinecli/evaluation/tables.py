"""Test differences between methods for significance, and format tables.

All methods are given the same draws of lights, and a draw that is hard for one method is usually
hard for the others. Therefore, the test uses the differences trial by trial: a paired t-test
(Student, Biometrika 1908), corrected for the number of pairs of methods on one capture (Holm,
Scandinavian Journal of Statistics 1979). It covers only the variation between draws. A significant
difference generalises to other lights on the same capture, but not to other captures.

Tables are formatted as Markdown, LaTeX, or rows for a terminal, from one evaluation or from several
with the same methods that differ in n_lights, light_noise_deg or both.
"""

import re
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from splinecli.errors import printable
from splinecli.evaluation.protocol import Evaluation, heading, lights_value, protocol_in_words
from splinecli.maths import Float64Array
from splinecli.records.documents import ComparisonReport

AVERAGE = "average"  # used instead of a capture's name for the average over all captures
SIGNIFICANCE = 0.05  # p-value below which two methods differ
_SAME_DEG = 1e-6  # error maps are float32, so MAEs closer than this are considered equal


def compare(evaluation: Evaluation) -> list[ComparisonReport]:
    """Return comparisons of every pair of methods, on every capture and on average.

    Trial t of the average is the mean of trial t over the captures; see trial_averages.
    """
    errors = {
        name: {r.method: r.maes_deg for r in evaluation.results if r.capture == name}
        for name in evaluation.captures
    }
    errors[AVERAGE] = {method: trial_averages(evaluation, method) for method in evaluation.methods}
    protocol = evaluation.protocol
    settings = {"n_lights": lights_value(protocol), "light_noise_deg": protocol.light_noise_deg}
    return [
        each
        for capture, of in errors.items()
        for each in _compare_all(of, capture=capture, **settings)
    ]


def trial_averages(evaluation: Evaluation, method: str) -> tuple[float, ...]:
    """Return the MAE of a method in degrees for each trial, averaged over the captures.

    If a capture has only one trial, for example because it has just K lights, this trial is
    repeated. If the numbers of trials differ otherwise, only the trials that all captures have are
    averaged.
    """
    maes_deg = [result.maes_deg for result in evaluation.results if result.method == method]
    most = max(map(len, maes_deg))
    repeated = [trials * most if len(trials) == 1 else trials for trials in maes_deg]
    return tuple(float(np.mean(trial)) for trial in zip(*repeated, strict=False))


def comparison_in_words(c: ComparisonReport) -> str:
    """Return a sentence that describes a comparison."""
    better, worse = (c.first, c.second) if c.difference_deg < 0 else (c.second, c.first)
    size = f"{abs(c.difference_deg):.2f} degrees"
    if c.interval_deg is None or c.p_holm is None:
        reason = "one trial" if c.trials == 1 else f"the same in all {c.trials} trials"
        return f"{better} scores {size} less than {worse} (not tested, {reason})."
    test = f"{p_in_words(c.p_holm)}, {c.trials} trials"
    low, high = c.interval_deg
    if c.differs:
        low, high = sorted((abs(low), abs(high)))
        return (
            f"{better} is better than {worse} by {size} (95 % interval {low:.2f} to {high:.2f},"
            f" {test})."
        )
    interval = f"95 % interval {low:+.2f} to {high:+.2f}"
    details = f"{c.difference_deg:+.2f} degrees, {interval}, {test}"
    return f"{c.first} and {c.second} do not differ significantly ({details})."


def p_in_words(p_value: float) -> str:
    """Return a p-value as text, such as "p < 0.001" or "p = 0.032"."""
    return (
        "p < 0.001"
        if p_value < 0.001
        else f"p = {p_value:.3f}"
        if p_value < 0.1
        else f"p = {p_value:.2f}"
    )


def _compare_all(maes_deg: dict[str, tuple[float, ...]], **settings: Any) -> list[ComparisonReport]:
    compared = []
    for first, second in combinations(maes_deg, 2):
        differences = np.subtract(maes_deg[first], maes_deg[second])
        interval_deg, p_value = _paired_test(differences)
        comparison = ComparisonReport(
            first=first,
            second=second,
            trials=len(differences),
            difference_deg=float(differences.mean()),
            std_deg=float(differences.std()),
            interval_deg=interval_deg,
            p_value=p_value,
            p_holm=None,
            differs=None,
            **settings,
        )
        compared.append(comparison)
    tested = [(c, c.p_value) for c in compared if c.p_value is not None]
    for (c, _), p_holm in zip(tested, holm([p_value for _, p_value in tested]), strict=True):
        c.p_holm, c.differs = p_holm, p_holm < SIGNIFICANCE
    return compared


def _paired_test(differences: Float64Array) -> tuple[tuple[float, float] | None, float | None]:
    """Return the 95 % confidence interval and the p-value of a t-test of differences (T,) against
    zero.
    """
    if len(differences) > 1 and np.abs(differences).max() < _SAME_DEG:
        return (0.0, 0.0), 1.0
    if len(differences) < 2 or np.ptp(differences) < _SAME_DEG:
        return None, None
    from scipy import stats

    test = stats.ttest_1samp(differences, 0)
    low, high = test.confidence_interval(1 - SIGNIFICANCE)
    return (float(low), float(high)), float(test.pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values after Holm's step-down correction.

    The k-th smallest of m p-values is multiplied by m + 1 - k. Corrected values are non-decreasing
    and at most 1.
    """
    order = np.argsort(p_values, kind="stable")
    stepped = np.array(p_values)[order] * np.arange(len(p_values), 0, -1)
    corrected = np.empty(len(p_values))
    corrected[order] = np.maximum.accumulate(stepped).clip(max=1)
    return [float(p) for p in corrected]


# With more captures, the table uses small type, so that DiLiGenT's ten captures fit on a page.
_MOST_WIDE = 6
_LATEX = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    # In TeX's default font encoding (OT1), these codes stand for other characters.
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
)


def table_rows(evaluation: Evaluation) -> list[list[str]]:
    """Return a header row, then one row for each method: name, MAE on each capture, and average.

    The errors have two decimals.
    """
    mae_deg = {(result.method, result.capture): result.mae_deg for result in evaluation.results}
    rows = [["method", *(printable(name) for name in evaluation.captures), AVERAGE]]
    for method, average in evaluation.averages.items():
        values = [*(mae_deg[method, capture] for capture in evaluation.captures), average]
        rows.append([method, *(f"{value:.2f}" for value in values)])
    return rows


def best_cells(rows: Sequence[Sequence[str]]) -> set[tuple[int, int]]:
    """Return the (row, column) of the smallest printed values in each column.

    The set is empty for a single method.
    """
    best = set()
    if len(rows) > 2:
        for column in range(1, len(rows[0])):
            smallest = min(float(row[column]) for row in rows[1:])
            best |= {
                (i, column) for i, row in enumerate(rows) if i and float(row[column]) == smallest
            }
    return best


def caption(evaluation: Evaluation) -> str:
    """Return a table's caption, such as "Mean angular error in degrees: 10 lights, ..."."""
    return f"Mean angular error in degrees: {protocol_in_words(evaluation.protocol)}."


def markdown(evaluations: Sequence[Evaluation]) -> str:
    """Return a Markdown table of methods by captures and their average, followed by a caption.

    The best value in each column is bold. Several evaluations have separate tables with headings.
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

    table* spans both columns of a two-column paper.
    """
    needs = "% Needs \\usepackage{booktabs} in the preamble.\n"
    return needs + "\n".join(_latex_table(evaluation) for evaluation in evaluations)


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\`*<>|\[\]&~])", r"\\\1", " ".join(text.split()))


def _latex_table(evaluation: Evaluation) -> str:
    head, *rows = (
        " & ".join(row) + r" \\"
        for row in _marked_rows(evaluation, _escape_latex, r"\textbf{{{}}}")
    )
    best = " The best of each column in bold." if len(rows) > 1 else ""
    narrow = (
        [r"  \footnotesize\setlength{\tabcolsep}{2pt}"]
        if len(evaluation.captures) > _MOST_WIDE
        else []
    )
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


def _marked_rows(
    evaluation: Evaluation, escape: Callable[[str], str], bold: str
) -> list[list[str]]:
    """Return table_rows with the best cells formatted by a template for bold text."""
    rows = table_rows(evaluation)
    best = best_cells(rows)
    return [
        [
            bold.format(escape(cell)) if (r, c) in best else escape(cell)
            for c, cell in enumerate(row)
        ]
        for r, row in enumerate(rows)
    ]


def _escape_latex(text: str) -> str:
    return text.translate(_LATEX)
