"""Write the files of an evaluation: results, tables, plots and an HTML report.

All functions take one evaluation, or several with the same methods that differ in n_lights,
light_noise_deg or both.
"""

import csv
import io
import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from splinecli._version import __version__
from splinecli.errors import printable
from splinecli.evaluation import tables
from splinecli.evaluation.figures import CaptureFigure, light_noise_curves, lights_curves
from splinecli.evaluation.protocol import (
    EVERY_CAPTURE,
    Evaluation,
    Protocol,
    all_skipped,
    heading,
    lights_value,
)
from splinecli.evaluation.tables import AVERAGE, compare, table_rows
from splinecli.records.documents import (
    ComparisonReport,
    MethodResult,
    ProtocolReport,
    RelightingReport,
)
from splinecli.records.output_files import LIGHT_NOISE_PLOT, LIGHT_PLOT
from splinecli.results.pages import picture_url, render
from splinecli.system.publishing import new_files

_MOST_SENTENCES = 3  # pairs of three methods; more pairs are easier to read in a matrix
_MINUS = "\N{MINUS SIGN}"
_RESTORED = (
    "lens blur removed, saturated observations restored, unknown light intensities estimated, as"
    " infer does"
)
_AS_STORED = "as stored: nothing restored, unknown light intensities assumed to be equal"
Mark = Literal["", "star", "best"]


class Cell(NamedTuple):
    """A cell of a table: its text, a remark in smaller type, and a mark.

    "star" adds a star, and "best" a star and a colour.
    """

    text: str
    remark: str = ""
    mark: Mark = ""


Table = list[list[Cell]]  # a header row, then rows whose first cell is a header


def html_report(
    evaluations: Sequence[Evaluation], figures: Sequence[tuple[str, bytes]], notes: Sequence[str]
) -> str:
    """Return the report of one evaluation, or of several with different lights or light noise.

    `figures` are pairs of a caption, which is also the alternative text, and a PNG. `notes` are
    sentences about the captures.
    """
    first, captures = evaluations[0], _captures(evaluations)
    return render(
        "report.html",
        title=f"{_count(len(first.methods), 'method')} on {_count(len(captures), 'capture')}",
        protocol=_protocol(evaluations),
        notes=notes,
        skipped=[(s.capture, s.reason) for s in all_skipped(evaluations)],
        summary=_summary(evaluations) if len(evaluations) > 1 else None,
        several_methods=len(first.methods) > 1,
        sections=[_section(evaluation) for evaluation in evaluations],
        figures=[_figure(caption, png) for caption, png in figures],
        significance=tables.SIGNIFICANCE,
    )


def _protocol(evaluations: Sequence[Evaluation]) -> list[tuple[str, str]]:
    first = evaluations[0].protocol
    lights = dict.fromkeys(f"{lights_value(e.protocol)} lights" for e in evaluations)
    noises = dict.fromkeys(f"{e.protocol.light_noise_deg:g}" for e in evaluations)
    drawn = f"as in {first.draws_file.name}" if first.draws_file else "at random from the seed"
    trials = sorted({r.trials for e in evaluations for r in e.results}, reverse=True)
    others = {EVERY_CAPTURE: "every other capture"}
    left_out = ", ".join(
        f"the first {count} of {others.get(name, name)}" for name, count in first.skip_first.items()
    )
    everything = "all that have ground truth"
    at_most = f"at most {first.max_pixels} of each capture, at random"
    weights = ", ".join(
        f"{method}: {weights['name']} (SHA-256 {weights['sha256'][:12]})"
        for method, used in evaluations[0].settings.items()
        if (weights := used["weights"]) is not None
    )
    rows = [
        ("Methods", ", ".join(evaluations[0].methods)),
        ("Weights", weights),
        ("Captures", ", ".join(_captures(evaluations))),
        ("Image values", _AS_STORED if first.as_stored else _RESTORED),
        ("Lights", ", ".join(lights)),
        ("Trials", " or ".join(map(str, trials))),
        ("Draws of lights", f"{drawn}, the same for all methods"),
        ("Seed", str(first.seed)),
        ("Light noise", "none" if list(noises) == ["0"] else f"{', '.join(noises)} degrees"),
        ("Images left out", left_out),
        ("Pixels scored", everything if first.max_pixels is None else at_most),
        ("splinecli", __version__),
    ]
    return [(term, value) for term, value in rows if value]


def _section(evaluation: Evaluation) -> dict[str, Any]:
    comparisons = compare(evaluation)
    average = [c for c in comparisons if c.capture == AVERAGE]
    many = len(average) > _MOST_SENTENCES
    return {
        "heading": heading(evaluation.protocol),
        "errors": _error_table(evaluation),
        "seconds": _seconds_table(evaluation),
        "sentences": [] if many else list(map(tables.comparison_in_words, average)),
        "matrix": _matrix(evaluation.methods, average) if many else None,
        "pairs": list(map(_pair_row, comparisons)),
    }


def _summary(evaluations: Sequence[Evaluation]) -> Table:
    """Return a table of methods by evaluations, made of the last columns of their tables."""
    columns = [[Cell(name) for name in ("method", *evaluations[0].methods)]]
    for evaluation in evaluations:
        averages = [row[-1] for row in _error_table(evaluation)[1:]]
        columns.append([Cell(heading(evaluation.protocol)), *averages])
    return [list(row) for row in zip(*columns, strict=True)]


def _error_table(evaluation: Evaluation) -> Table:
    """Return a table of methods by captures and their average: the MAE and its standard deviation.

    The standard deviation is over the trials.
    """
    header, *rows = table_rows(evaluation)
    best = tables.best_cells([header, *rows])
    maes_deg = {(r.method, r.capture): r.maes_deg for r in evaluation.results}
    body = []
    for r, (method, *values) in enumerate(rows, start=1):
        trials = [maes_deg[method, capture] for capture in evaluation.captures]
        trials.append(tables.trial_averages(evaluation, method))
        cells = [
            Cell(
                value,
                f"± {np.std(maes):.2f}" if len(maes) > 1 else "",
                "best" if (r, c) in best else "",
            )
            for c, (value, maes) in enumerate(zip(values, trials, strict=True), start=1)
        ]
        body.append([Cell(method), *cells])
    return [[Cell(name) for name in header], *body]


def _seconds_table(evaluation: Evaluation) -> Table:
    seconds = {(r.method, r.capture): r.seconds for r in evaluation.results}
    body = [
        [
            Cell(method),
            *(Cell(f"{seconds[method, capture]:.3g}") for capture in evaluation.captures),
        ]
        for method in evaluation.methods
    ]
    return [[Cell("method"), *(Cell(printable(capture)) for capture in evaluation.captures)], *body]


def _matrix(methods: Sequence[str], comparisons: Sequence[ComparisonReport]) -> Table:
    """Return a table of MAE differences, row method minus column method.

    Significant differences are marked.
    """
    cells = {}
    for c in comparisons:
        for sign, pair in ((1, (c.first, c.second)), (-1, (c.second, c.first))):
            difference = sign * c.difference_deg
            mark: Mark = "" if not c.differs else "best" if difference < 0 else "star"
            cells[pair] = Cell(_signed(difference), mark=mark)
    body = [
        [Cell(row), *(cells.get((row, column), Cell("")) for column in methods)] for row in methods
    ]
    return [[Cell("method"), *(Cell(method) for method in methods)], *body]


def _pair_row(c: ComparisonReport) -> dict[str, str]:
    if c.interval_deg is None or c.p_holm is None:
        interval = p_value = "not tested"
    else:
        interval = " to ".join(map(_signed, c.interval_deg))
        p_value = tables.p_in_words(c.p_holm)
    better = c.first if c.difference_deg < 0 else c.second
    verdict = {None: "", True: f"{better} is better", False: "no"}
    return {
        "capture": c.capture,
        "pair": f"{c.first} {_MINUS} {c.second}",
        "difference": _signed(c.difference_deg),
        "interval": interval,
        "p": p_value,
        "differs": verdict[c.differs],
    }


def _figure(caption: str, png: bytes) -> dict[str, Any]:
    # from the IHDR chunk, which always comes first
    width, height = struct.unpack(">II", png[16:24])
    return {
        "caption": caption,
        "url": picture_url(png),
        "width": width,
        "height": height,
        "wide": width > 2 * height,
    }


def _signed(value_deg: float) -> str:
    return f"{value_deg:+.2f}".replace("-", _MINUS)


def _captures(evaluations: Sequence[Evaluation]) -> list[str]:
    return list(dict.fromkeys(capture for e in evaluations for capture in e.captures))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


TRIALS, REPORT, RESULTS, FIGURES = "trials.jsonl", "report.html", "results.json", "figures"


def _make_plots(evaluations: Sequence[Evaluation]) -> dict[str, tuple[str, bytes]]:
    """Return plots of the error against each setting that varies, by file name.

    Each is a pair of a caption and a PNG.
    """
    plots: dict[str, tuple[str, bytes]] = {}
    if not set.intersection(*(set(evaluation.captures) for evaluation in evaluations)):
        return plots
    protocols = [evaluation.protocol for evaluation in evaluations]
    if len({protocol.n_lights for protocol in protocols}) > 1:
        plots[LIGHT_PLOT] = "Error against the number of lights.", lights_curves(evaluations)
    if len({protocol.light_noise_deg for protocol in protocols}) > 1:
        plots[LIGHT_NOISE_PLOT] = "Error against the light noise.", light_noise_curves(evaluations)
    return plots


def write_results(
    output: Path,
    evaluations: Sequence[Evaluation],
    figures: Sequence[CaptureFigure] | None,
    relit: Sequence[RelightingReport] | None = None,
) -> dict[str, Any]:
    """Write all files, replacing an earlier evaluation (see new_files), and return results.json.

    The caller must have locked the folder. If `figures` is None, the figures of an earlier
    evaluation are kept.
    """
    document, plots = results_document(evaluations), _make_plots(evaluations)
    if relit is not None:
        document["relighting"] = [each.as_dict() for each in relit]
    shown = [*plots.values(), *((figure.caption, figure.png) for figure in figures or ())]
    texts = {
        "results.csv": results_csv(evaluations),
        "table.md": tables.markdown(evaluations),
        "table.tex": tables.latex(evaluations),
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

    With several evaluations, `protocol` lists the values in which they differ, and `averages` has
    an entry for each evaluation under each method, named by these values: {"ls": {"10": 16.1,
    "all": 15.4}}. p-values have three significant digits.
    """
    return {
        "schema": 1,
        "protocol": _protocol_record([evaluation.protocol for evaluation in evaluations]),
        "methods": {name: dict(settings) for name, settings in evaluations[0].settings.items()},
        "results": _records(evaluations),
        "averages": _averages(evaluations),
        "comparisons": [
            _rounded(c.as_dict()) for evaluation in evaluations for c in compare(evaluation)
        ],
        "skipped": [skipped.as_dict() for skipped in all_skipped(evaluations)],
        "notes": list(
            dict.fromkeys(note for evaluation in evaluations for note in evaluation.notes)
        ),
        "version": __version__,
    }


def results_csv(evaluations: Sequence[Evaluation]) -> str:
    """Return a header and one line for each result, as in `results` of results.json."""
    text = io.StringIO()
    records = _records(evaluations)
    for record in records:
        del record["maes_deg"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(records[0])
    writer.writerows(map(_as_text_cell, record.values()) for record in records)
    return text.getvalue()


def _as_text_cell(value: Any) -> Any:
    """Return a value as a one-line cell.

    An apostrophe marks a text that a spreadsheet could interpret as a formula.
    """
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.lstrip().startswith(("=", "+", "-", "@")) else text


def _protocol_record(protocols: Sequence[Protocol]) -> dict[str, Any]:
    first = protocols[0]
    names = ProtocolReport.__struct_fields__
    values: dict[str, Any] = {name: getattr(first, name, None) for name in names}
    values |= {
        "n_lights": _one_or_list(map(lights_value, protocols)),
        "draws": first.draws_file and first.draws_file.name,
        "light_noise_deg": _one_or_list(protocol.light_noise_deg for protocol in protocols),
        "lights_estimated": first.finds_lights,
    }
    return ProtocolReport(**values).as_dict()


def _records(evaluations: Sequence[Evaluation]) -> list[dict[str, Any]]:
    """Return the fields of MethodResult for each result, taken from the result or its protocol."""
    names = MethodResult.__struct_fields__
    pairs = [(result, e.protocol) for e in evaluations for result in e.results]
    return [
        _rounded(
            {name: getattr(result if hasattr(result, name) else protocol, name) for name in names}
        )
        for result, protocol in pairs
    ]


def _averages(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    averages = [_rounded(e.averages) for e in evaluations]
    if len(evaluations) == 1:
        return averages[0]
    # Keys are the values that differ between evaluations, such as "10", "2.5" or "10, 2.5".
    lights = [str(lights_value(e.protocol)) for e in evaluations]
    noise = [f"{e.protocol.light_noise_deg:g}" for e in evaluations]
    differing = [values for values in (lights, noise) if len(set(values)) > 1] or [lights]
    keys = [", ".join(values) for values in zip(*differing, strict=True)]
    methods = dict.fromkeys(method for average in averages for method in average)
    return {
        method: {key: average[method] for key, average in zip(keys, averages, strict=True)}
        for method in methods
    }


def _rounded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values with degrees and seconds rounded to four decimals; the light noise is
    unchanged.

    p-values span many orders of magnitude, so they have three significant digits.
    """

    def rounded(name: str, value: Any) -> Any:
        if isinstance(value, tuple):
            return [rounded(name, each) for each in value]
        if not isinstance(value, float) or name == "light_noise_deg":
            return value
        return float(f"{value:.3g}") if name.startswith("p_") else round(value, 4)

    return {name: rounded(name, value) for name, value in values.items()}


def _one_or_list(values: Iterable[Any]) -> Any:
    different = list(dict.fromkeys(values))
    return different[0] if len(different) == 1 else different
