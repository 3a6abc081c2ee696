"""Run `infer` on many captures, in this process or on others, and go on past a capture that fails."""

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, lru_cache, partial
from pathlib import Path

from splinecli.errors import InputError, ModelError, SplinecliError
from splinecli.methods import Estimator, MethodOptions
from splinecli.pipeline.capture_memory import choose_workers, expected_bytes
from splinecli.pipeline.connection import ClusterOptions
from splinecli.pipeline.distribution import SAME_STORAGE, Item, LostError, distributor, this_worker
from splinecli.pipeline.infer import make_method
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.member import Member, Outcome, Redo, Shard, failed, list_captures, run_member
from splinecli.results.index import INDEX, Entry, check_index_free, has_index, index_page, with_earlier
from splinecli.system.files import check_writable, write_text
from splinecli.system.progress import SILENT, Observer
from splinecli.system.publishing import held_folder


def infer_batch(
    folders: Sequence[Path],
    options: InferOptions,
    observer: Observer = SILENT,
    *,
    redo: Redo = "nothing",
    shard: Shard | None = None,
    cluster: ClusterOptions | None = None,
) -> Iterator[Outcome]:
    """Run `infer_capture` on each folder and yield its outcome, in order, or on other processes as they end.

    With several captures, or where OUT/index.html is there already, that page is written at the end.

    Args:
        folders: the captures. A folder that is given twice counts once.
        redo: which captures that have results are computed again.
        cluster: the processes or machines that compute; None for this process. A number of workers of 0 means as many
            as the machine's cores and memory allow.

    Raises:
        UsageError: two captures have the same name, the options do not fit the method, or a "folder" that does not
            exist is the name of a map, format or method.
        InputError: a file that the options name does not exist.
        ModelError: the weights cannot be used.
        OutputError: the output folder cannot be written, or the disk is full. A single folder in it only fails.
        SplinecliError: the connection to a Dask scheduler was lost.
    """
    members = list_captures(folders, shard)
    options.check_files()
    output = Path(options.output)
    check_writable(output)
    with_index = len(members) > 1 or shard is not None or has_index(output)
    if with_index:
        check_index_free(output, overwrite=redo == "all")
    entries: dict[int, Entry] = {}
    if cluster is not None and cluster.address is None:
        if not cluster.workers:
            cluster = replace(cluster, workers=choose_workers(members, options))
        cluster = cluster.on_cores(len(members))
    outcomes: Iterable[tuple[int, Outcome]]
    if cluster is None:
        method = cache(partial(make_method, options))
        outcomes = enumerate(run_member(member, options, redo, method, observer) for member in members)
    else:
        outcomes = _on_workers(members, options, observer, redo, cluster)
    for number, outcome in outcomes:
        if outcome.status != "changed":
            entries[number] = Entry.of(outcome.report)
        yield outcome
    if with_index and members:
        with held_folder(output, observer.warn, wait=True):
            # Of those that changed it shows the results that were kept.
            shown = with_earlier([entries[number] for number in sorted(entries)], output)
            write_text(output / INDEX, index_page(shown, output))


def _on_workers(
    members: Sequence[Member], options: InferOptions, observer: Observer, redo: Redo, cluster: ClusterOptions
) -> Iterator[tuple[int, Outcome]]:
    """Yield the number and the outcome of each capture as it ends on another process."""
    # On any device: the machine of the command may have none of the workers' GPUs.
    weights = make_method(replace(options, device="cpu") if cluster.address else options).weights
    infer = partial(_infer, options, redo, None if weights is None else weights["sha256"])
    items = (
        Item((number, member), str(member.folder), expected_bytes(member, options))
        for number, member in enumerate(members)
    )
    with (
        distributor(infer, Path(options.output), cluster, observer) as workers,
        observer.progress("captures", len(members), unit="captures") as advance,
    ):
        began, n_failed, n_pixels = time.monotonic(), 0, 0
        for n_ended, (item, result) in enumerate(workers.run(items), start=1):
            number, member = item.args
            outcome, warnings = (failed(member.name, result), []) if isinstance(result, LostError) else result
            for warning in warnings:
                observer.warn(warning)
            n_failed += outcome.exit_code != 0
            n_pixels += outcome.report["n_pixels"] if outcome.status == "done" else 0
            advance(
                1,
                f"{n_ended - n_failed} done, {n_failed} failed, {len(workers.running)} running,"
                f" {n_pixels / (time.monotonic() - began):,.0f} pixels/s",
            )
            yield number, outcome


class _Warnings(Observer):
    """Keeps warnings, which go back with the report."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def warn(self, message: str) -> None:
        self.found.append(message)


def _infer(
    options: InferOptions, redo: Redo, sha256: str | None, number: int, member: Member
) -> tuple[Outcome, list[str]]:
    """Compute a capture on a worker, and return what became of it and the warnings."""
    options.check_files()
    estimator = _method(options, options.method_options, sha256)
    if member.missing is None and not os.path.lexists(member.folder):
        problem = f"the folder does not exist on the worker {this_worker()}"
        member = replace(member, missing=InputError(problem, path=member.folder, hint=SAME_STORAGE))
    observer = _Warnings()
    return run_member(member, options, redo, lambda: estimator, observer), observer.found


@lru_cache(maxsize=1)
def _method(options: InferOptions, method: MethodOptions, sha256: str | None) -> Estimator:
    """Return the estimator of this worker; loading it takes a second. Options are equal on any device, `method` not."""
    estimator = make_method(options)
    found = None if estimator.weights is None else estimator.weights["sha256"]
    if found != sha256:
        raise ModelError(
            f"the weights have the SHA-256 {found}, expected {sha256} as on the machine of the command",
            path=options.weights,
            hint="Use the same file, and the same version of splinecli, everywhere",
        )
    return estimator


def worst_exit_code(codes: Iterable[int]) -> int:
    """Return the exit code of a batch: 1 if there is a defect, else the highest number."""
    found = set(codes)
    return SplinecliError.exit_code if SplinecliError.exit_code in found else max(found, default=0)
