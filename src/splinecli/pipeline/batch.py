"""Run `infer` on many captures, in this or other processes, and continue if a capture fails.

Duplicate folders are ignored. Captures with up-to-date results are skipped. If a capture fails, its
error is recorded.
"""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

from splinecli._version import __version__
from splinecli.capture import capture_name
from splinecli.capture.files import IMAGE_SUFFIXES
from splinecli.capture.formats.film import is_film
from splinecli.errors import InputError, ModelError, OutputError, SplinecliError, UsageError
from splinecli.estimate.methods import Estimator, MethodOptions, method_names
from splinecli.pipeline.distribution import (
    SAME_STORAGE,
    LostError,
    WorkItem,
    distributor,
    this_worker,
)
from splinecli.pipeline.incoming import unpacked
from splinecli.pipeline.infer import (
    BASE_BYTES,
    held_results,
    infer_capture,
    inputs_sha256,
    loads_first,
    make_method,
    source_bytes,
)
from splinecli.pipeline.infer_options import HERE, ClusterOptions, InferOptions, Redo, Shard
from splinecli.records.output_files import MAPS, NORMALS, REPORT, own_files
from splinecli.results.files import UNUSABLE, UnfinishedError, read_report
from splinecli.results.pages import (
    INDEX,
    IndexEntry,
    check_index_free,
    has_index,
    index_page,
    with_earlier,
)
from splinecli.system.files import (
    NoRoomError,
    as_splinecli_error,
    check_writable,
    find_mode,
    resolve,
    write_text,
)
from splinecli.system.machine import (
    available_memory,
    choose_device,
    count_available_cores,
    is_out_of_memory,
    meanwhile,
)
from splinecli.system.progress import SILENT, Observer
from splinecli.system.publishing import held_folder, is_plain


@dataclass(frozen=True)
class BatchItem:
    """A capture of a batch.

    If the folder does not exist, `missing` is the error that says so.
    """

    folder: Path
    name: str
    missing: InputError | None = None


def list_captures(folders: Sequence[Path], shard: Shard | None = None) -> list[BatchItem]:
    """Return the captures in the given order, without duplicate folders.

    Raises UsageError if images are given instead of their folder, two captures have the same name,
    or a "folder" that does not exist is the name of a map, format or method.
    """
    if folders and all(
        path.suffix.lower() in IMAGE_SUFFIXES and os.path.isfile(path)  # noqa: PTH113 - Path raises for long names
        for path in folders
    ):
        given = "an image was" if len(folders) == 1 else f"{len(folders)} images were"
        raise UsageError(
            f"{given} given, expected the folder with the images",
            hint=f"Pass the folder {str(folders[0].parent)!r}",
        )
    folders = list({_own_path(folder): folder for folder in reversed(folders)}.values())[::-1]
    chosen = set(folders)
    if shard is not None:
        # Sort by bytes, because the shell's order of captures/* depends on the locale, which may
        # differ between the machines of a cluster.
        chosen = set(sorted(folders, key=os.fsencode)[shard.number - 1 :: shard.n_parts])
    # Include the captures of the other shards, because their results go to the same place.
    members = {folder: _batch_item(folder) for folder in folders}
    seen: dict[str, Path] = {}
    for folder, member in members.items():
        if member.missing is None and (other := seen.setdefault(member.name, folder)) is not folder:
            raise UsageError(
                f"{other} and {folder} have the same name, so their results would overwrite each"
                " other",
                hint="Run them one by one with different -o",
            )
    return [member for folder, member in members.items() if folder in chosen]


def _own_path(folder: Path) -> Path:
    """Return the same path for all spellings of a folder.

    A link keeps its name, because its results use that name.
    """
    try:
        return resolve(folder) if ".." in folder.parts else folder.absolute()
    except InputError:
        return folder  # the error is reported when this capture is processed


def _batch_item(folder: Path) -> BatchItem:
    """Return the capture in the folder.

    Raises UsageError for a value that belongs to another option.
    """
    # If a folder cannot be read, the error is reported when that capture is processed.
    name = folder.name
    try:
        exists = find_mode(folder) is not None
        if exists:
            name = capture_name(folder)
    except InputError:
        exists = True
    if exists:
        return BatchItem(folder, name)
    if str(folder) in (*MAPS, *NORMALS, *method_names()):
        raise UsageError(
            "the folder does not exist",
            path=folder,
            hint="Write lists with commas, such as --maps albedo,confidence",
        )
    kind = "video" if is_film(folder) else "folder"
    missing = InputError(f"the {kind} does not exist", path=folder)
    return BatchItem(folder, name or str(folder), missing)


Status = Literal["done", "skipped", "changed", "missing", "failed"]


@dataclass(frozen=True)
class Outcome:
    """Outcome of one capture.

    `skipped` results are up to date; `changed` ones are out of date and were kept.
    """

    status: Status
    report: dict[str, Any]  # the report of the results, or the document {capture, error, exit_code}
    exit_code: int = 0
    trace: str = ""  # the Python traceback of an error that splinecli did not expect


def run_member(
    member: BatchItem,
    options: InferOptions,
    redo: Redo,
    method: Callable[[], Estimator],
    observer: Observer,
) -> Outcome:
    """Compute one capture of a batch, unless its results are up to date or must be kept.

    `method` returns the estimator; it is called only if the capture is computed. Its UsageError or
    ModelError is passed on, because it would affect every capture. Raises NoRoomError if the disk
    is full or read-only.
    """
    if member.missing is not None:
        return failed(member.name, member.missing, status="missing")
    try:
        folder = unpacked(member.folder, Path(options.output), options, observer, redo=redo)
        member, options = replace(member, folder=folder), options.with_settings(folder)
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
    if loads_first(options):
        method()
    with meanwhile(method) as load:  # read images during the seconds that PyTorch takes to load
        try:
            return Outcome("done", infer_capture(member.folder, options, observer, load=load))
        except Exception as error:
            load()  # an error while loading the method takes precedence
            return _failure(member, error)


def _failure(member: BatchItem, error: Exception) -> Outcome:
    """Return the outcome of a failed capture.

    Raises NoRoomError, because the other captures would fail, too.
    """
    trace = ""
    if is_out_of_memory(error):
        error = SplinecliError(
            "there is not enough memory",
            path=member.folder,
            hint="Close other programs, or use smaller images",
        )
    elif isinstance(error, OSError):
        error = as_splinecli_error(error, member.folder)
    elif not isinstance(error, SplinecliError):
        trace = "".join(traceback.format_exception(error))
        error = SplinecliError(
            f"{member.name}: {type(error).__name__}: {error}. This is a defect of splinecli",
            hint="Please report it with the lines above",
        )
    if isinstance(error, NoRoomError):
        raise error
    return failed(member.name, error, trace)


def failed(
    name: str, error: SplinecliError, trace: str = "", *, status: Status = "failed"
) -> Outcome:
    """Return the outcome of a capture without results from this run."""
    document = {"capture": name, "error": str(error), "exit_code": error.exit_code}
    return Outcome(status, document, error.exit_code, trace)


class ChangedError(OutputError):
    """A folder contains results from other input files, other options or another version."""


def find_earlier(
    target: Path, folder: Path, options: InferOptions, warn: Callable[[str], object]
) -> dict[str, Any] | None:
    """Return the report in `target` if its results match the capture and the options.

    Return None if there are no results. If an interrupted run left partial results, `warn` is
    called with a sentence about them. Raises ChangedError for results of another capture or other
    options, InputError, or OutputError if `target` is also the capture's folder, where the user's
    own files may have the names of results.
    """
    try:
        report = read_report(target)
        earlier = InferOptions.from_dict(report["options"])
        version, stamp = report["version"], report["inputs_sha256"]
        if IndexEntry.of(report).row.capture != target.name:  # raises if the report is incomplete
            raise ValueError
    except UnfinishedError as error:
        found = next((name for name in own_files() if (target / name).exists()), None)
        if found is None:
            return None
        if not is_plain(target / REPORT) and target.samefile(folder):
            raise OutputError(
                f"contains {found}, but no {REPORT}, and is the folder of the capture",
                path=target,
                hint="Add --overwrite, or choose another place with -o",
            ) from None
        warn(f"{target}: {error}, so the capture is computed again")
        return None
    except (*UNUSABLE, OverflowError, SplinecliError):
        made = "by another version"
    else:
        if version != __version__:
            made = f"by version {version}"
        elif names := options.changes(earlier):
            several = f"other options ({', '.join(names)})"
            made = f"with {several if len(names) > 1 else f'another {names[0]}'}"
        elif stamp != inputs_sha256(options.open(folder), options.weights):
            made = "from other input files"
        else:
            return report
    raise ChangedError(
        f"contains results made {made}",
        path=target,
        hint="Add --update to redo changed captures, --overwrite to redo everything, or choose"
        " another place with -o",
    )


def infer_batch(
    folders: Sequence[Path],
    options: InferOptions,
    observer: Observer = SILENT,
    *,
    redo: Redo = "nothing",
    shard: Shard | None = None,
    cluster: ClusterOptions = HERE,
) -> Iterator[Outcome]:
    """Run `infer_capture` on each folder and yield the outcomes.

    Outcomes are in order or, with other processes, yielded as captures finish. With several
    captures, or if OUT/index.html already exists, that page is written at the end.

    Args:
        folders: the captures. Duplicates are ignored.
        redo: which captures with existing results are computed again.
        cluster: the processes or machines to run on. If `workers` is 0, there are as many as the
            machine's cores and memory allow.

    Raises:
        UsageError: see list_captures, or the options do not fit the method.
        InputError, ModelError: a file that the options name does not exist, or the weights cannot
            be used.
        OutputError: the output folder cannot be written, or the disk is full. If only the folder of
            one capture cannot be written, that capture fails and the batch continues.
        SplinecliError: the connection to a Dask scheduler was lost.
    """
    members = list_captures(folders, shard)
    options.check_files()
    output = Path(options.output)
    check_writable(output)
    with_index = len(members) > 1 or shard is not None or has_index(output)
    if with_index:
        check_index_free(output, overwrite=redo == "all")
    entries: dict[int, IndexEntry] = {}
    if cluster.address is None and not cluster.workers:
        cluster = cluster.replace(workers=choose_workers(members, options))
    outcomes: Iterable[tuple[int, Outcome]]
    if elsewhere := cluster.on_cores(len(members)):
        outcomes = _on_workers(members, options, observer, redo, elsewhere)
    else:
        method = cache(partial(make_method, options))
        outcomes = enumerate(
            run_member(member, options, redo, method, observer) for member in members
        )
    for number, outcome in outcomes:
        if outcome.status != "changed":
            entries[number] = IndexEntry.of(outcome.report)
        yield outcome
    if with_index and members:
        with held_folder(output, observer.warn, wait=True):
            # For changed captures, the page shows the results that were kept.
            shown = with_earlier([entries[number] for number in sorted(entries)], output)
            write_text(output / INDEX, index_page(shown, output))


def _on_workers(
    members: Sequence[BatchItem],
    options: InferOptions,
    observer: Observer,
    redo: Redo,
    cluster: ClusterOptions,
) -> Iterator[tuple[int, Outcome]]:
    """Yield the number and the outcome of each capture as it finishes in another process."""
    # Accept any device, because the workers may have GPUs that the command's machine does not have.
    weights = make_method(options.replace(device="cpu") if cluster.address else options).weights
    infer = partial(_infer, options, redo, None if weights is None else weights["sha256"])
    items = (
        WorkItem((n, each), str(each.folder), expected_bytes(each, options))
        for n, each in enumerate(members)
    )
    with (
        distributor(infer, Path(options.output), cluster, observer) as workers,
        observer.progress("captures", len(members), unit="captures") as advance,
    ):
        began, n_failed, n_pixels = time.monotonic(), 0, 0
        for n_ended, (item, result) in enumerate(workers.run(items), start=1):
            number, member = item.args
            outcome, warnings = (
                (failed(member.name, result), []) if isinstance(result, LostError) else result
            )
            for message, once, again in warnings:
                observer.warn(message, once=once, again=again)
            n_failed += outcome.exit_code != 0
            n_pixels += outcome.report["n_pixels"] if outcome.status == "done" else 0
            speed = n_pixels / (time.monotonic() - began)
            done = f"{n_ended - n_failed} done, {n_failed} failed, {len(workers.running)} running"
            advance(1, f"{done}, {speed:,.0f} pixels/s")
            yield number, outcome


class _Warnings(Observer):
    """Collects warnings, which are returned with the report."""

    def __init__(self) -> None:
        self.found: list[tuple[str, str | None, str]] = []

    def warn(self, message: str, *, once: str | None = None, again: str = "") -> None:
        self.found.append((message, once, again))


def _infer(
    options: InferOptions, redo: Redo, sha256: str | None, number: int, member: BatchItem
) -> tuple[Outcome, list[tuple[str, str | None, str]]]:
    options.check_files()
    estimator = _method(options, options.method_options, sha256)
    if member.missing is None and not os.path.lexists(member.folder):
        member = replace(
            member,
            missing=InputError(
                f"the folder does not exist on the worker {this_worker()}",
                path=member.folder,
                hint=SAME_STORAGE,
            ),
        )
    observer = _Warnings()
    return run_member(member, options, redo, lambda: estimator, observer), observer.found


@lru_cache(maxsize=1)
def _method(options: InferOptions, method: MethodOptions, sha256: str | None) -> Estimator:
    """Return this worker's estimator, which is kept because loading it takes a second.

    Raises ModelError if its weights differ from those on the machine of the command.
    """
    estimator = make_method(options)
    found = None if estimator.weights is None else estimator.weights["sha256"]
    if found != sha256:
        raise ModelError(
            f"the weights have the SHA-256 {found}, expected {sha256} as on the machine of the"
            " command",
            path=options.weights,
            hint="Use the same file, and the same version of splinecli, everywhere",
        )
    return estimator


def worst_exit_code(codes: Iterable[int]) -> int:
    """Return the exit code of a batch: 1 for a defect of splinecli, otherwise the highest code."""
    found = set(codes)
    return SplinecliError.exit_code if SplinecliError.exit_code in found else max(found, default=0)


def expected_bytes(member: BatchItem, options: InferOptions) -> float:
    """Return the approximate memory in bytes that `infer` needs for a capture. See source_bytes."""
    n_lights = options.n_lights or len(options.light_indices or ())
    return source_bytes(lambda: options.open(member.folder), n_lights)


def choose_workers(members: Sequence[BatchItem], options: InferOptions) -> int:
    """Return how many captures this machine can compute in parallel with its cores and memory.

    A GPU computes one capture at a time.
    """
    if choose_device(options.device).type == "cuda":
        return 1
    asked = members[:: max(1, len(members) // 16)]  # a sample that represents the batch
    each = BASE_BYTES + max((expected_bytes(member, options) for member in asked), default=0.0)
    return int(max(1, min(count_available_cores(), len(members), available_memory() / each)))
