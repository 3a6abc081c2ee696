"""Run `infer` on many captures: skip what is done, and go on past a capture that fails."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splinecli.errors import InputError, OutputError, SplinecliError, UsageError
from splinecli.memory import is_out_of_memory
from splinecli.pipeline.finished import find_earlier
from splinecli.pipeline.infer import infer_capture, make_method
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.observer import SILENT, Observer

if TYPE_CHECKING:
    from splinecli.methods import Estimator

Redo = Literal["nothing", "changed", "all"]
"""What to do with captures that have results: keep them all, redo what changed, or redo everything."""

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


def infer_batch(
    folders: Sequence[Path], options: InferOptions, observer: Observer = SILENT, *, redo: Redo = "nothing"
) -> Iterator[Outcome]:
    """Run `infer_capture` on each folder and yield its outcome, in order.

    With several captures, or where OUT/index.html is there already, that page is written at the end.

    Args:
        folders: the captures. A folder that is given twice counts once.
        options, observer: see infer_capture.
        redo: which captures that have results are computed again.

    Raises:
        UsageError: two captures have the same name, the options do not fit the method, or a "folder" that does not
            exist is the name of a map, format or method.
        InputError: a file that the options name does not exist.
        ModelError: the weights cannot be used.
        OutputError: the output folder cannot be written, or the disk is full.
    """
    from splinecli.files import check_writable
    from splinecli.results.index import check_index_free, has_index

    folders = list({_own_path(folder): folder for folder in reversed(folders)}.values())[::-1]
    missing = _missing(folders)
    names = [_name(folder) for folder in folders]
    _check_names({folder: name for folder, name in zip(folders, names, strict=True) if folder not in missing})
    options.check_files()
    output = Path(options.output)
    check_writable(output)
    with_index = len(folders) > 1 or has_index(output)
    if with_index:
        check_index_free(output, overwrite=redo == "all")
    estimator: Estimator | None = None
    outcomes = []
    for folder, name in zip(folders, names, strict=True):
        try:
            outcome = missing.get(folder) or _earlier_outcome(folder, name, options, observer, redo)
        except Exception as error:
            outcome = _failure(name, folder, error)
        if outcome is None:
            # A wrong method or wrong weights end the batch: they are wrong for every capture.
            estimator = estimator or make_method(options)
            try:
                report = infer_capture(folder, options, observer, estimator=estimator)
                outcome = Outcome(name, "done", report)
            except Exception as error:
                outcome = _failure(name, folder, error)
        outcomes.append(outcome)
        yield outcome
    if with_index:
        _write_index(outcomes, output, observer)


def worst_exit_code(codes: Iterable[int]) -> int:
    """Return the exit code of a batch: 1 if there is a defect, else the highest number."""
    found = set(codes)
    return SplinecliError.exit_code if SplinecliError.exit_code in found else max(found, default=0)


def _error_document(error: SplinecliError, capture: str) -> dict[str, Any]:
    """Return the document that stands in place of the report of a capture."""
    return {"capture": capture, "error": str(error), "exit_code": error.exit_code}


def _own_path(folder: Path) -> Path:
    """Return one path for all spellings of a folder. A link keeps its name, because its results have it."""
    from splinecli.capture.paths import resolve

    try:
        return resolve(folder) if ".." in folder.parts else folder.absolute()
    except InputError:
        return folder  # what is wrong with it is reported when its turn comes


def _missing(folders: Sequence[Path]) -> dict[Path, Outcome]:
    """Return a failure for each folder that does not exist. Raises UsageError for a word of another option."""
    from splinecli.capture.paths import find_mode
    from splinecli.methods import method_names
    from splinecli.results.files import MAPS, NORMALS

    outcomes = {}
    for folder in folders:
        try:
            exists = find_mode(folder) is not None
        except InputError:
            exists = True  # what is wrong with it is reported when its turn comes
        if exists:
            continue
        if str(folder) in (*MAPS, *NORMALS, *method_names()):
            raise UsageError(
                "the folder does not exist",
                path=folder,
                hint="Write lists with commas, such as --maps albedo,confidence",
            )
        error = InputError("the folder does not exist", path=folder)
        outcomes[folder] = replace(_failed(folder.name or str(folder), error), status="missing")
    return outcomes


def _name(folder: Path) -> str:
    from splinecli.capture import capture_name

    try:
        return capture_name(folder)
    except InputError:
        return folder.name  # what is wrong with it is reported when its turn comes


def _check_names(names: Mapping[Path, str]) -> None:
    seen: dict[str, Path] = {}
    for folder, name in names.items():
        other = seen.setdefault(name, folder)
        if other is not folder:
            raise UsageError(
                f"{other} and {folder} have the same name, so their results would overwrite each other",
                hint="Run them one by one with different -o",
            )


def _earlier_outcome(
    folder: Path, name: str, options: InferOptions, observer: Observer, redo: Redo
) -> Outcome | None:
    """Return the outcome of a capture that is not to be computed, or None."""
    from splinecli.files import check_writable
    from splinecli.publishing import held_folder

    target = Path(options.output) / name
    check_writable(target)
    if redo == "all":
        return None
    with held_folder(target, observer.warn):
        earlier = find_earlier(target, folder, options)
    if earlier.report is not None:
        return Outcome(name, "skipped", earlier.report)
    if not earlier.changed or (redo == "changed" and earlier.ours):
        return None
    update = "--update to redo what changed, " if earlier.ours else ""
    error = OutputError(
        earlier.changed,
        path=target,
        hint=f"Add {update}--overwrite to redo everything, or choose another place with -o",
    )
    return Outcome(name, "changed", _error_document(error, name), error.exit_code)


def _failure(name: str, folder: Path, error: Exception) -> Outcome:
    """Return what became of a capture that failed. Raises OutputError again, but for BusyError: it ends the batch."""
    from splinecli.locks import BusyError

    if isinstance(error, OutputError) and not isinstance(error, BusyError):
        raise error
    if isinstance(error, SplinecliError):
        return _failed(name, error)
    if isinstance(error, OSError) and not is_out_of_memory(error):
        reason = error.strerror or str(error)
        if error.errno in _NO_ROOM:
            raise OutputError(f"cannot be written ({reason})", path=error.filename) from error
        return _failed(name, InputError(f"cannot be read ({reason})", path=error.filename or folder))
    if is_out_of_memory(error):
        hint = "Use smaller images, or lower --batch-size"
        return _failed(name, SplinecliError("there is not enough memory", path=folder, hint=hint))
    defect = SplinecliError(
        f"{name}: {type(error).__name__}: {error}. This is a defect of splinecli",
        hint="Please report it with the lines above",
    )
    return _failed(name, defect, "".join(traceback.format_exception(error)))


def _failed(name: str, error: SplinecliError, trace: str = "") -> Outcome:
    return Outcome(name, "failed", _error_document(error, name), error.exit_code, trace)


def _write_index(outcomes: Sequence[Outcome], output: Path, observer: Observer) -> None:
    """Write the page of all captures. Of those that changed it shows the results that were kept."""
    from splinecli.files import write_text
    from splinecli.publishing import held_folder
    from splinecli.results.index import INDEX, index_page, with_earlier

    reports = [outcome.report for outcome in outcomes if outcome.status != "changed"]
    with held_folder(output, observer.warn, wait=True):
        write_text(output / INDEX, index_page(with_earlier(reports, output)))
