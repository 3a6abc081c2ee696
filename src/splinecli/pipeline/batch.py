"""Run `infer` on many captures: skip what is done, and go on past a capture that fails."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splinecli.errors import InputError, OutputError, SplinecliError
from splinecli.memory import is_out_of_memory
from splinecli.pipeline.capture_list import Member, Shard, list_captures
from splinecli.pipeline.finished import find_earlier
from splinecli.pipeline.infer import held_results, infer_capture, make_method
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.observer import SILENT, Observer

if TYPE_CHECKING:
    from splinecli.methods import Estimator
    from splinecli.pipeline.connection import ClusterOptions
    from splinecli.results.index import Entry

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
    folders: Sequence[Path],
    options: InferOptions,
    observer: Observer = SILENT,
    *,
    redo: Redo = "nothing",
    shard: Shard | None = None,
    cluster: ClusterOptions | None = None,
) -> Iterator[Outcome]:
    """Run `infer_capture` on each folder and yield its outcome.

    The outcomes come in order, or on other processes as they end.

    With several captures, or where OUT/index.html is there already, that page is written at the end.

    Args:
        folders: the captures. A folder that is given twice counts once.
        options, observer: see infer_capture.
        redo: which captures that have results are computed again.
        shard: the part of the captures that is computed; None for all.
        cluster: the processes or machines that compute; None for this process. A number of workers of 0 means as many
            as the machine's cores and memory allow.

    Raises:
        UsageError: two captures have the same name, the options do not fit the method, or a "folder" that does not
            exist is the name of a map, format or method.
        InputError: a file that the options name does not exist.
        ModelError: the weights cannot be used.
        OutputError: the output folder cannot be written, or the disk is full.
        SplinecliError: the connection to a Dask scheduler was lost.
    """
    from splinecli.files import check_writable
    from splinecli.results.index import Entry, check_index_free, has_index

    members = list_captures(folders, shard)
    options.check_files()
    output = Path(options.output)
    check_writable(output)
    with_index = len(members) > 1 or shard is not None or has_index(output)
    if with_index:
        check_index_free(output, overwrite=redo == "all")
    entries: dict[int, Entry] = {}
    for number, outcome in _outcomes(members, options, observer, redo, cluster):
        if outcome.status != "changed":
            entries[number] = Entry.of(outcome.report)
        yield outcome
    if with_index and members:
        _write_index([entries[number] for number in sorted(entries)], output, observer)


def _outcomes(
    members: Sequence[Member],
    options: InferOptions,
    observer: Observer,
    redo: Redo,
    cluster: ClusterOptions | None,
) -> Iterator[tuple[int, Outcome]]:
    """Yield the number and the outcome of each capture."""
    if cluster is not None and cluster.address is None:
        from splinecli.pipeline.capture_memory import choose_workers

        if not cluster.workers:
            cluster = replace(cluster, workers=choose_workers(members, options))
        cluster = cluster.on_cores(len(members))
    if cluster is None:
        yield from enumerate(_one_by_one(members, options, observer, redo))
        return
    from splinecli.pipeline.batch_on_workers import infer_on_workers

    yield from infer_on_workers(members, options, observer, redo=redo, cluster=cluster)


def _one_by_one(
    members: Sequence[Member], options: InferOptions, observer: Observer, redo: Redo
) -> Iterator[Outcome]:
    """Yield the outcomes of captures that this process computes."""
    estimator: Estimator | None = None

    def method() -> Estimator:
        nonlocal estimator
        estimator = estimator or make_method(options)
        return estimator

    for member in members:
        yield run_member(member, options, redo, method, observer)


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
        return replace(failed(member.name, member.missing), status="missing")
    try:
        outcome = _earlier_outcome(member, options, observer, redo)
    except Exception as error:
        outcome = _failure(member, error)
    if outcome is not None:
        return outcome
    estimator = method()
    try:
        return Outcome(
            member.name, "done", infer_capture(member.folder, options, observer, estimator=estimator)
        )
    except Exception as error:
        return _failure(member, error)


def worst_exit_code(codes: Iterable[int]) -> int:
    """Return the exit code of a batch: 1 if there is a defect, else the highest number."""
    found = set(codes)
    return SplinecliError.exit_code if SplinecliError.exit_code in found else max(found, default=0)


def _error_document(error: SplinecliError, capture: str) -> dict[str, Any]:
    """Return the document that stands in place of the report of a capture."""
    return {"capture": capture, "error": str(error), "exit_code": error.exit_code}


def _earlier_outcome(member: Member, options: InferOptions, observer: Observer, redo: Redo) -> Outcome | None:
    """Return the outcome of a capture that is not to be computed, or None."""
    if redo == "all":
        return None
    with held_results(member.name, options, observer) as target:
        earlier = find_earlier(target, member.folder, options)
    if earlier.report is not None:
        return Outcome(member.name, "skipped", earlier.report)
    if earlier.unfinished:
        observer.warn(f"{target}: {earlier.unfinished}, so it is computed again")
    if not earlier.changed or redo == "changed":
        return None
    error = OutputError(
        earlier.changed,
        path=target,
        hint="Add --update to redo what changed, --overwrite to redo everything, or choose another place with -o",
    )
    return Outcome(member.name, "changed", _error_document(error, member.name), error.exit_code)


def _failure(member: Member, error: Exception) -> Outcome:
    """Return what became of a capture that failed. Raises OutputError again, if other folders would fail, too."""
    from splinecli.locks import RefusedFolderError

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
        hint = "Use smaller images, or lower --batch-size"
        return failed(name, SplinecliError("there is not enough memory", path=member.folder, hint=hint))
    defect = SplinecliError(
        f"{name}: {type(error).__name__}: {error}. This is a defect of splinecli",
        hint="Please report it with the lines above",
    )
    return failed(name, defect, "".join(traceback.format_exception(error)))


def failed(name: str, error: SplinecliError, trace: str = "") -> Outcome:
    """Return the outcome of a capture that failed."""
    return Outcome(name, "failed", _error_document(error, name), error.exit_code, trace)


def _write_index(entries: Sequence[Entry], output: Path, observer: Observer) -> None:
    """Write the page of all captures. Of those that changed it shows the results that were kept."""
    from splinecli.files import write_text
    from splinecli.publishing import held_folder
    from splinecli.results.index import INDEX, index_page, with_earlier

    with held_folder(output, observer.warn, wait=True):
        write_text(output / INDEX, index_page(with_earlier(entries, output), output))
