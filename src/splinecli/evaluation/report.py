"""An evaluation as one HTML file that needs no other file: to mail, to print, or to keep."""

import struct
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from splinecli import __version__
from splinecli.errors import printable
from splinecli.evaluation.protocol import EVERY_CAPTURE, Evaluation, all_captures, all_skipped, heading, lights_in_words
from splinecli.evaluation.statistics import (
    AVERAGE,
    SIGNIFICANCE,
    Comparison,
    compare,
    in_words,
    p_in_words,
    trial_averages,
)
from splinecli.evaluation.tables import best_cells, table_rows
from splinecli.results.templates import picture_url, render

_MOST_SENTENCES = 3  # pairs, those of three methods; more pairs are easier to read in a matrix
_MINUS = "\N{MINUS SIGN}"
_RESTORED = "saturated observations restored, unknown light intensities estimated, as infer does"
_AS_STORED = "as stored: nothing restored, unknown light intensities taken to be equal"

Mark = Literal["", "star", "best"]


class Cell(NamedTuple):
    """A table's cell: its text, a remark in smaller type, and a mark. "best" is a star and a colour."""

    text: str
    remark: str = ""
    mark: Mark = ""


Table = list[list[Cell]]  # a header row, then rows whose first cell is a header


def html_report(evaluations: Sequence[Evaluation], figures: Sequence[tuple[str, bytes]], notes: Sequence[str]) -> str:
    """Return the report of one evaluation, or of several that differ in the lights or the light noise.

    `figures` are pairs of a caption, which is also the alternative text, and a PNG; `notes` sentences about the
    captures.
    """
    first = evaluations[0]
    return render(
        "report.html",
        title=f"{_count(len(first.methods), 'method')} on {_count(len(all_captures(evaluations)), 'capture')}",
        protocol=_protocol(evaluations),
        notes=notes,
        skipped=[(s.capture, s.reason) for s in all_skipped(evaluations)],
        summary=_summary(evaluations) if len(evaluations) > 1 else None,
        several_methods=len(first.methods) > 1,
        sections=[_section(evaluation) for evaluation in evaluations],
        figures=[_figure(caption, png) for caption, png in figures],
        significance=SIGNIFICANCE,
    )


def _protocol(evaluations: Sequence[Evaluation]) -> list[tuple[str, str]]:
    first = evaluations[0].protocol
    lights = dict.fromkeys(lights_in_words(e.protocol) for e in evaluations)
    noises = dict.fromkeys(f"{e.protocol.light_noise_deg:g}" for e in evaluations)
    drawn = "at random from the seed" if first.draws_file is None else f"those of {first.draws_file.name}"
    trials = sorted({r.trials for e in evaluations for r in e.results}, reverse=True)
    left_out = ", ".join(
        f"the first {count} of {'every other capture' if name == EVERY_CAPTURE else name}"
        for name, count in first.skip_first.items()
    )
    everything = "all that have ground truth"
    at_most = f"at most {first.max_pixels} of each capture, at random"
    weights = [
        f"{method}: {used['weights']['name']} (SHA-256 {used['weights']['sha256'][:12]})"
        for method, used in evaluations[0].settings.items()
        if used["weights"] is not None
    ]
    return [
        ("Methods", ", ".join(evaluations[0].methods)),
        *([("Weights", ", ".join(weights))] if weights else []),
        ("Captures", ", ".join(all_captures(evaluations))),
        ("Image values", _AS_STORED if first.as_stored else _RESTORED),
        ("Lights", ", ".join(lights)),
        ("Trials", " or ".join(map(str, trials))),
        ("Draws of lights", f"{drawn}, the same for all methods"),
        ("Seed", str(first.seed)),
        ("Light noise", "none" if list(noises) == ["0"] else f"{', '.join(noises)} degrees"),
        *([("Images left out", left_out)] if left_out else []),
        ("Pixels scored", everything if first.max_pixels is None else at_most),
        ("splinecli", __version__),
    ]


def _section(evaluation: Evaluation) -> dict[str, Any]:
    comparisons = compare(evaluation)
    average = [c for c in comparisons if c.capture == AVERAGE]
    return {
        "heading": heading(evaluation.protocol),
        "errors": _error_table(evaluation),
        "seconds": _seconds_table(evaluation),
        "sentences": [in_words(c) for c in average] if len(average) <= _MOST_SENTENCES else [],
        "matrix": _matrix(evaluation.methods, average) if len(average) > _MOST_SENTENCES else None,
        "pairs": [_pair_row(c) for c in comparisons],
    }


def _summary(evaluations: Sequence[Evaluation]) -> Table:
    """Return a table of methods by evaluations: the last column of each evaluation's table."""
    columns = [[Cell(name) for name in ("method", *evaluations[0].methods)]]
    for evaluation in evaluations:
        columns.append([Cell(heading(evaluation.protocol)), *(row[-1] for row in _error_table(evaluation)[1:])])
    return [list(row) for row in zip(*columns, strict=True)]


def _error_table(evaluation: Evaluation) -> Table:
    """Return a table of methods by captures and the average: MAE and its standard deviation over the trials."""
    header, *rows = table_rows(evaluation)
    best = best_cells([header, *rows])
    maes_deg = {(r.method, r.capture): r.maes_deg for r in evaluation.results}
    body = []
    for r, (method, *values) in enumerate(rows, start=1):
        trials = [maes_deg[method, capture] for capture in evaluation.captures]
        trials.append(trial_averages(evaluation, method))
        cells = [
            Cell(value, f"± {np.std(maes):.2f}" if len(maes) > 1 else "", "best" if (r, c) in best else "")
            for c, (value, maes) in enumerate(zip(values, trials, strict=True), start=1)
        ]
        body.append([Cell(method), *cells])
    return [[Cell(name) for name in header], *body]


def _seconds_table(evaluation: Evaluation) -> Table:
    """Return a table of methods by captures: seconds for each trial."""
    seconds = {(r.method, r.capture): r.seconds for r in evaluation.results}
    body = [
        [Cell(method), *(Cell(f"{seconds[method, capture]:.3g}") for capture in evaluation.captures)]
        for method in evaluation.methods
    ]
    return [[Cell("method"), *(Cell(printable(capture)) for capture in evaluation.captures)], *body]


def _matrix(methods: Sequence[str], comparisons: Sequence[Comparison]) -> Table:
    """Return a table of the MAE of the row's method minus that of the column's; a mark where they differ."""
    cells = {}
    for c in comparisons:
        for row, column, difference_deg in (
            (c.first, c.second, c.difference_deg),
            (c.second, c.first, -c.difference_deg),
        ):
            mark: Mark = "" if not c.differs else "best" if difference_deg < 0 else "star"
            cells[row, column] = Cell(_signed(difference_deg), mark=mark)
    body = [[Cell(row), *(cells.get((row, column), Cell("")) for column in methods)] for row in methods]
    return [[Cell("method"), *(Cell(method) for method in methods)], *body]


def _pair_row(c: Comparison) -> dict[str, str]:
    if c.interval_deg is None or c.p_holm is None:
        interval = p_value = "not tested"
    else:
        interval = " to ".join(map(_signed, c.interval_deg))
        p_value = p_in_words(c.p_holm)
    verdict = {None: "", True: f"{c.first if c.difference_deg < 0 else c.second} is better", False: "no"}
    return {
        "capture": c.capture,
        "pair": f"{c.first} {_MINUS} {c.second}",
        "difference": _signed(c.difference_deg),
        "interval": interval,
        "p": p_value,
        "differs": verdict[c.differs],
    }


def _figure(caption: str, png: bytes) -> dict[str, Any]:
    width, height = struct.unpack(">II", png[16:24])  # from the IHDR chunk, which always comes first
    return {"caption": caption, "url": picture_url(png), "width": width, "height": height, "wide": width > 2 * height}


def _signed(value_deg: float) -> str:
    return f"{value_deg:+.2f}".replace("-", _MINUS)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
