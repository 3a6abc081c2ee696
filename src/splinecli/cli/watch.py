"""`splinecli watch`: run `infer` on each capture that arrives in a folder."""

import time
from pathlib import Path
from typing import Any

import typer
from typer import Argument, Option

from splinecli.cli.console import Messages
from splinecli.errors import InputError, UsageError

_LOOK_SECONDS = 1.0  # time between two looks at the folder


def watch(
    context: typer.Context,
    folder: Path = Argument(
        ..., metavar="FOLDER", help="Folder in which captures arrive, a subfolder or film for each."
    ),
    options: list[str] = Argument(None, metavar="-- OPTIONS", help="Options of infer, after two dashes."),
    marker: str | None = Option(
        None, metavar="NAME", help="File that appears in a subfolder when it is complete. [default: see --settle]"
    ),
    settle: float = Option(
        5.0,
        metavar="SECONDS",
        min=0,
        help="A film, or without --marker a subfolder, is complete when nothing in it changed for so long.",
    ),
) -> None:
    """Run infer on each capture that arrives in FOLDER, once it is complete.

    A capture is a subfolder of FOLDER, or a film with --lights estimate. It is computed as by infer with OPTIONS, and
    captures that are already done are skipped, so the command can be stopped and started again at any time. A capture
    that fails does not stop it. It is tried again when its files change. If FOLDER vanishes, the command waits for it.
    Ctrl-C or SIGTERM ends the command, with exit code 130.
    """
    from splinecli.pipeline.arrivals import Arrivals

    options = options or []
    infer: Any = context.parent.command.get_command(context.parent, "infer")  # type: ignore[union-attr]
    run = infer.make_context("infer", [*options, "--", str(folder)], parent=context.parent)
    given, output = run.params, run.params["output"].expanduser()
    if given["as_json"]:
        raise UsageError("--json prints one list at the end, and watch has none", hint="Give --jsonl")
    if given["shard"] is not None:
        raise UsageError(
            "--shard splits a list of captures, and watch has none", hint="Watch one folder for each shard"
        )
    if len(given["captures"]) > 1:
        raise UsageError(f"found {given['captures'][0]} after the dashes, expected options of infer")
    if output.resolve() == folder.resolve():
        raise UsageError("the results would lie among the captures", path=output, hint="Give another -o OUT")
    given["captures"] = []
    infer.invoke(run)  # refuses wrong options now, not when the first capture arrives
    arrivals = Arrivals(folder, marker=marker, seconds=settle, without=output)
    messages = Messages(quiet=given["quiet"])
    messages.say(f"{folder}: waiting for captures; Ctrl-C ends")
    ready, is_there = arrivals.take(), True
    while True:
        if ready:
            run.params["captures"] = ready
            infer.invoke(run)
        else:
            time.sleep(_LOOK_SECONDS)
        try:
            ready = arrivals.take()
            if not is_there:
                messages.say(f"{folder}: the folder is there again")
            is_there = True
        except InputError as error:  # a network drive may be away for a moment
            if is_there:
                messages.warn(f"{error} Waiting for it.")
            ready, is_there = [], False
