"""One capture of a batch of `infer`: skip it if its results are up to date, and keep its error if it fails."""

import errno
import traceback
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from splinecli import __version__
from splinecli.errors import OutputError, SplinecliError
from splinecli.methods import Estimator
from splinecli.pipeline.capture_list import Member
from splinecli.pipeline.films import unpacked
from splinecli.pipeline.infer import held_results, infer_capture, inputs_sha256
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.observer import Observer
from splinecli.results.files import OWN_FILES, REPORT, UnfinishedError, read_report
from splinecli.results.index import Entry
from splinecli.system.files import as_input_error
from splinecli.system.locks import RefusedFolderError
from splinecli.system.memory import is_out_of_memory
from splinecli.system.publishing import is_plain

Redo = Literal["nothing", "changed", "all"]  # of the captures that have results

Status = Literal["done", "skipped", "changed", "missing", "failed"]

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one capture.

    Args:
        status: done, skipped (results are up to date), changed (results are out of date and were kept), missing
            (there is no such folder) or failed.
        report: the report of the results, or the document {capture, error, exit_code}.
        trace: the Python traceback of an error that splinecli did not expect.
    """

    status: Status
    report: dict[str, Any]
    exit_code: int = 0
    trace: str = ""


def run_member(
    member: Member, options: InferOptions, redo: Redo, method: Callable[[], Estimator], observer: Observer
) -> Outcome:
    """Compute one capture of a batch, unless its results are up to date or are to be kept.

    `method` returns the estimator; it is called if the capture is computed.

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
                return Outcome("skipped", report)
    except ChangedError as error:
        if redo == "nothing":
            return failed(member.name, error, status="changed")
    except Exception as error:
        return _failure(member, error)
    estimator = method()
    try:
        return Outcome("done", infer_capture(member.folder, options, observer, estimator=estimator))
    except Exception as error:
        return _failure(member, error)


def _failure(member: Member, error: Exception) -> Outcome:
    """Return what became of a capture that failed. Raises OutputError again, if other folders would fail, too."""
    if isinstance(error, OutputError) and not isinstance(error, RefusedFolderError):
        raise error
    trace = ""
    if is_out_of_memory(error):
        hint = "Close other programs, or use smaller images"
        error = SplinecliError("there is not enough memory", path=member.folder, hint=hint)
    elif isinstance(error, OSError):
        if error.errno in _NO_ROOM:
            raise OutputError(f"cannot be written ({error.strerror})", path=error.filename) from error
        error = as_input_error(error, member.folder)
    elif not isinstance(error, SplinecliError):
        trace = "".join(traceback.format_exception(error))
        error = SplinecliError(
            f"{member.name}: {type(error).__name__}: {error}. This is a defect of splinecli",
            hint="Please report it with the lines above",
        )
    return failed(member.name, error, trace)


def failed(name: str, error: SplinecliError, trace: str = "", *, status: Status = "failed") -> Outcome:
    """Return the outcome of a capture that has no results of this run."""
    document = {"capture": name, "error": str(error), "exit_code": error.exit_code}
    return Outcome(status, document, error.exit_code, trace)


class ChangedError(OutputError):
    """A folder has results of other input files, other options or another version."""

    def __init__(self, made: str, folder: Path) -> None:
        hint = "Add --update to redo what changed, --overwrite to redo everything, or choose another place with -o"
        super().__init__(f"contains results made {made}", path=folder, hint=hint)


def find_earlier(
    target: Path, folder: Path, options: InferOptions, warn: Callable[[str], object]
) -> dict[str, Any] | None:
    """Return the report in `target` if its results are those of the capture in `folder` and the options.

    Without results it is None. If an interrupted run left some, `warn` receives a sentence about that.

    Raises:
        ChangedError: the results are not those of this capture and these options.
        InputError: the capture cannot be read.
        RefusedFolderError: both are one folder, which may have files of the user with the names of results.
    """
    try:
        report = read_report(target)
        earlier = InferOptions.from_dict(report["options"])
        version, stamp = report["version"], report["inputs_sha256"]
        if Entry.of(report).row.capture != target.name:  # raises if the report is not whole
            raise ValueError
    except UnfinishedError as error:
        found = next((name for name in OWN_FILES if (target / name).exists()), None)
        if found is None:
            return None
        if not is_plain(target / REPORT) and target.samefile(folder):
            raise RefusedFolderError(
                f"contains {found}, but no {REPORT}, and is the folder of the capture",
                path=target,
                hint="Add --overwrite, or choose another place with -o",
            ) from None
        warn(f"{target}: {error}, so it is computed again")
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, SplinecliError):
        raise ChangedError("by another version", target) from None
    if version != __version__:
        raise ChangedError(f"by version {version}", target)
    if earlier != options:
        names = [
            "--" + option.name.replace("formats", "format").replace("_", "-")
            for option in fields(options)
            if option.compare and getattr(earlier, option.name) != getattr(options, option.name)
        ]
        differences = f"another {names[0]}" if len(names) == 1 else f"other options ({', '.join(names)})"
        raise ChangedError(f"with {differences}", target)
    if stamp != inputs_sha256(options.open(folder), options.weights):
        raise ChangedError("from other input files", target)
    return report
