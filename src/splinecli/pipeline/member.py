"""One capture of a batch of `infer`: skip it if its results are up to date, and keep its error if it fails."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from splinecli.errors import InputError, OutputError, SplinecliError
from splinecli.methods import Estimator
from splinecli.pipeline.capture_list import Member
from splinecli.pipeline.films import unpacked
from splinecli.pipeline.finished import ChangedError, find_earlier
from splinecli.pipeline.infer import held_results, infer_capture
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.observer import Observer
from splinecli.system.locks import RefusedFolderError
from splinecli.system.memory import is_out_of_memory

Redo = Literal["nothing", "changed", "all"]  # of the captures that have results

Status = Literal["done", "skipped", "changed", "missing", "failed"]

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one capture.

    Args:
        capture: its name.
        status: done, skipped (results are up to date), changed (results are out of date and were kept), missing
            (there is no such folder) or failed.
        report: the report of the results, or the document {capture, error, exit_code}.
        exit_code: of this capture.
        trace: the Python traceback of an error that splinecli did not expect.
    """

    capture: str
    status: Status
    report: dict[str, Any]
    exit_code: int = 0
    trace: str = ""


def run_member(
    member: Member, options: InferOptions, redo: Redo, method: Callable[[], Estimator], observer: Observer
) -> Outcome:
    """Compute one capture of a batch, unless its results are up to date or are to be kept.

    Args:
        member: the capture.
        options, observer: see infer_capture.
        redo: see infer_batch.
        method: returns the estimator; it is called if the capture is computed.

    Raises:
        UsageError, ModelError: what `method` raises. It is wrong for every capture.
        OutputError: the output folder cannot be written, or the disk is full.
    """
    if member.missing is not None:
        return failed(member.name, member.missing, status="missing")
    try:
        folder = unpacked(member.folder, Path(options.output), options, observer, redo=redo)
        member = replace(member, folder=folder)
        if redo != "all":
            with held_results(member.name, options, observer) as target:
                report = find_earlier(target, folder, options, observer.warn)
            if report is not None:
                return Outcome(member.name, "skipped", report)
    except ChangedError as error:
        if redo == "nothing":
            return failed(member.name, error, status="changed")
    except Exception as error:
        return _failure(member, error)
    estimator = method()
    try:
        return Outcome(member.name, "done", infer_capture(member.folder, options, observer, estimator=estimator))
    except Exception as error:
        return _failure(member, error)


def _failure(member: Member, error: Exception) -> Outcome:
    """Return what became of a capture that failed. Raises OutputError again, if other folders would fail, too."""
    name = member.name
    if isinstance(error, OutputError) and not isinstance(error, RefusedFolderError):
        raise error
    if isinstance(error, SplinecliError):
        return failed(name, error)
    if isinstance(error, OSError) and not is_out_of_memory(error):
        reason = error.strerror or str(error)
        if error.errno in _NO_ROOM:
            raise OutputError(f"cannot be written ({reason})", path=error.filename) from error
        return failed(name, InputError(f"cannot be read ({reason})", path=error.filename or member.folder))
    if is_out_of_memory(error):
        hint = "Close other programs, or use smaller images"
        return failed(name, SplinecliError("there is not enough memory", path=member.folder, hint=hint))
    defect = SplinecliError(
        f"{name}: {type(error).__name__}: {error}. This is a defect of splinecli",
        hint="Please report it with the lines above",
    )
    return failed(name, defect, "".join(traceback.format_exception(error)))


def failed(name: str, error: SplinecliError, trace: str = "", *, status: Status = "failed") -> Outcome:
    """Return the outcome of a capture that has no results of this run."""
    document = {"capture": name, "error": str(error), "exit_code": error.exit_code}
    return Outcome(name, status, document, error.exit_code, trace)
