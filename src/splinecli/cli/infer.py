"""The commands infer, watch and info: normal maps of captures, and a summary of a capture."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from typer import Context

from splinecli.cli.console import Messages, print_lines, print_report
from splinecli.errors import InputError, UsageError, printable

if TYPE_CHECKING:
    from splinecli.pipeline.batch import Outcome
    from splinecli.pipeline.infer_options import (
        BatchOptions,
        ClusterOptions,
        InferOptions,
        InfoOptions,
        ReadingOptions,
        WatchOptions,
    )
    from splinecli.results.pages import IndexRow

# Descriptions of outcomes in the last line
_WORDS = {"skipped": "already done", "changed": "changed but kept"}


def infer(
    context: Context, options: InferOptions, batch: BatchOptions, cluster: ClusterOptions
) -> int:
    """Estimate the normal map of each CAPTURE.

    A CAPTURE is a folder with images of one object, taken by a fixed camera under different lights.
    The light file is in the folder, or is given by --lights. With --lights estimate, a CAPTURE may
    be a video. Writes OUT/<name>/normals.png, normals.npy and report.json, and error_map.png if
    there is ground truth. With several captures, OUT/index.html links the results.

    Captures that are already done are skipped. If files or options of a capture have changed, infer
    reports this and keeps the old results. --update or --overwrite computes them again. A capture
    that fails does not stop the others. The most serious failure determines the exit code.
    """
    from splinecli.pipeline.batch import infer_batch

    messages = Messages(quiet=batch.quiet)
    outcomes = infer_batch(
        batch.captures,  # empty if watch only checks the options
        options,
        messages,
        redo=batch.redo,
        shard=batch.shard,
        cluster=cluster.replace(gpu=options.device == "cuda"),
    )
    summaries = not (batch.quiet or batch.as_json or batch.as_json_lines)
    return _show_all(outcomes, Path(options.output), messages, context.obj, summaries=summaries)


def _show_all(
    outcomes: Iterable[Outcome],
    output: Path,
    messages: Messages,
    document: Callable[[dict[str, Any]], None],
    *,
    summaries: bool,
) -> int:
    from splinecli.pipeline.batch import Status, worst_exit_code
    from splinecli.results.pages import HEADER, INDEX, IndexEntry

    statuses: Counter[str] = Counter()
    codes: set[int] = set()
    rows: list[IndexRow] = []
    for outcome in outcomes:
        document(outcome.report)
        if outcome.status == "done":
            if summaries:
                print(printable(_summary(outcome.report, output)))
        elif outcome.status == "skipped":
            messages.say(f"{output / outcome.report['capture']}: already done, skipped")
        else:  # printed even with --quiet
            if outcome.trace:
                print_lines(outcome.trace)
            messages.error(outcome.report["error"])
        statuses[outcome.status] += 1
        codes.add(outcome.exit_code)
        if outcome.status in ("done", "skipped"):
            rows.append(IndexEntry.of(outcome.report).row)
    if statuses.total() > 1:
        if rows:
            columns = [column for column in zip(HEADER, *rows, strict=True) if any(column[1:])]
            messages.table(list(zip(*columns, strict=True)))
        text = ", ".join(
            f"{statuses[name]} {_WORDS.get(name, name)}"
            for name in get_args(Status)
            if statuses[name]
        )
        messages.say(f"{statuses.total()} captures: {text}; see {output / INDEX}")
    return worst_exit_code(codes)


def _summary(report: dict[str, Any], output: Path) -> str:
    from splinecli.records.capture_warnings import PROBABLY_WRONG

    errors, expected = report["angular_error_deg"], report["expected_under_5"]
    scored = ""
    if errors is not None:
        scored = f", MAE {errors['mean']:.2f} deg (median {errors['median']:.2f})"
    elif expected is not None:
        doubted = any(warning["code"] in PROBABLY_WRONG for warning in report["warnings"])
        judged = report["capture_judged"] and not doubted
        condition = "" if judged else " if the lights and the images are right"
        scored = f", {expected:.0%} of them likely within 5 deg{condition}"
    counts = f"{report['n_pixels']} pixels, {report['n_lights']} lights"
    return (
        f"{output / report['capture']}: {counts}, {report['method']}{scored},"
        f" {report['seconds']['total']:.1f} s"
    )


def watch(context: Context, options: WatchOptions) -> None:
    """Run infer on each capture that arrives in FOLDER, once it is complete.

    A capture is a subfolder of FOLDER, or a video with --lights estimate. Each one is processed as
    infer does with OPTIONS. Captures that are already done are skipped, so the command can be
    stopped and started again at any time. It continues after a capture fails, and tries that
    capture again when its files change. If FOLDER vanishes, the command waits for it. Ctrl-C or
    SIGTERM ends the command, with exit code 130.
    """
    from splinecli.pipeline.incoming import Arrivals

    folder = options.folder
    infer: Any = context.parent.command.get_command(context.parent, "infer")  # type: ignore[union-attr]
    run = infer.make_context("infer", [*options.options, "--", str(folder)], parent=context.parent)
    given, output = run.params, run.params["output"].expanduser()
    if given["as_json"]:
        raise UsageError(
            "--json prints a list at the end, but watch does not end", hint="Use --jsonl instead"
        )
    if given["shard"] is not None:
        raise UsageError(
            "--shard splits a list of captures, but watch has no list",
            hint="Watch one folder for each shard",
        )
    if len(given["captures"]) > 1:
        raise UsageError(f"found {given['captures'][0]} after '--', expected options for infer")
    if output.resolve() == folder.resolve():
        raise UsageError(
            "the results would be among the captures", path=output, hint="Choose another -o OUT"
        )
    given["captures"] = []
    infer.invoke(run)  # reports invalid options before the first capture arrives
    arrivals = Arrivals(folder, marker=options.marker, seconds=options.settle, without=output)
    messages = Messages(quiet=given["quiet"])
    ready, is_there = arrivals.take(), True
    messages.say(f"{folder}: waiting for captures; press Ctrl-C to stop")
    while True:
        if ready:
            run.params["captures"] = ready
            infer.invoke(run)
        else:
            time.sleep(1.0)
        try:
            ready = arrivals.take()
            if not is_there:
                messages.say(f"{folder}: the folder is available again")
            is_there = True
        except InputError as error:  # a network drive may be temporarily unavailable
            if is_there:
                messages.warn(f"{error} Waiting for it.")
            ready, is_there = [], False


def info(reading: ReadingOptions, options: InfoOptions) -> int:
    """Describe CAPTURE as `infer` would read it, without estimating normals.

    Prints the layout and files of the capture, the size and bit depth of the images, their white
    level and exposure, the angles of the lights from the camera axis, and the memory and time that
    infer needs. Writes files only if an option requests them.
    """
    from splinecli.pipeline.info import describe_capture, summary_lines
    from splinecli.records.capture_warnings import PROBABLY_WRONG

    messages = Messages(quiet=options.quiet)
    report = describe_capture(options, reading, messages)
    print_report(report, *summary_lines(report), as_json=options.as_json, quiet=options.quiet)
    wrong = sorted(PROBABLY_WRONG.intersection(report["warning_codes"]))
    if reading.strict and wrong:
        messages.error(
            f"{options.capture}: an input is probably wrong ({', '.join(wrong)}); see the warnings."
        )
        return InputError.exit_code
    return 0
