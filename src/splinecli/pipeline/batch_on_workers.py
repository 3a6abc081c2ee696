"""A batch of `infer` on several processes or machines: one task a capture."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from splinecli.errors import InputError, ModelError
from splinecli.extras import import_extra
from splinecli.files import UNFINISHED, refusals_as_output_errors
from splinecli.pipeline.batch import Outcome, Redo, failed, run_member
from splinecli.pipeline.capture_list import Member
from splinecli.pipeline.capture_memory import expected_bytes
from splinecli.pipeline.cluster import Distributor
from splinecli.pipeline.connection import ClusterOptions, connected
from splinecli.pipeline.infer import make_method
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.observer import Observer
from splinecli.pipeline.tasks import LostError, Task
from splinecli.pipeline.worker import SAME_STORAGE, Work

if TYPE_CHECKING:
    from splinecli.methods import Estimator, MethodOptions


@dataclass(frozen=True)
class _Settings:
    """What all captures of a batch share, and the checksum of the weights on the machine of the command."""

    options: InferOptions
    redo: Redo
    weights_sha256: str | None


class _Warnings(Observer):
    """Keeps warnings, which go back with the report."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def warn(self, message: str) -> None:
        self.found.append(message)


def infer_on_workers(
    members: Sequence[Member],
    options: InferOptions,
    observer: Observer,
    *,
    redo: Redo,
    cluster: ClusterOptions,
) -> Iterator[tuple[int, Outcome]]:
    """Compute captures on other processes, and yield the number and the outcome of each as it ends.

    Raises:
        SplinecliError: what run_member raises on a worker, or what Distributor.run raises.
    """
    # On any device: the machine of the command may have none of the workers' GPUs.
    weights = make_method(replace(options, device="cpu") if cluster.address else options).weights
    settings = _Settings(options, redo, None if weights is None else weights["sha256"])
    with shared_probe(Path(options.output)) as probe, connected(cluster) as client:
        work = Work.of_this_process(settings, _prepare, _infer, probe)
        distributor = Distributor(client, work, cluster, observer)
        tasks = (
            Task((number, member), str(member.folder), expected_bytes(member, options))
            for number, member in enumerate(members)
        )
        with observer.progress("captures", len(members), unit="captures") as advance:
            began, n_failed, n_pixels = time.monotonic(), 0, 0
            for n_ended, (task, result) in enumerate(distributor.run(tasks), start=1):
                number, member = task.args
                if isinstance(result, LostError):
                    outcome = failed(member.name, result)
                else:
                    outcome, warnings = result
                    for warning in warnings:
                        observer.warn(warning)
                n_failed += outcome.exit_code != 0
                n_pixels += outcome.report["n_pixels"] if outcome.status == "done" else 0
                advance(
                    1,
                    f"{n_ended - n_failed} done, {n_failed} failed, {distributor.running} running,"
                    f" {n_pixels / (time.monotonic() - began):,.0f} pixels/s",
                )
                yield number, outcome


@contextmanager
def shared_probe(output: Path) -> Iterator[Path]:
    """Yield the path for a file in the output folder, by which workers know the folder. Both are made as needed.

    Raises:
        OutputError: the folder cannot be made.
    """
    probe = output / f".{uuid.uuid4().hex}{UNFINISHED}"
    with refusals_as_output_errors(output):
        made = [place for place in (output, *output.parents) if not place.exists()]
        output.mkdir(parents=True, exist_ok=True)
    try:
        yield probe.absolute()
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
            for place in made:
                place.rmdir()


def _prepare(settings: _Settings) -> None:
    """Check on a worker the files that the options name, and the weights."""
    settings.options.check_files()
    _method(settings)


def _infer(settings: _Settings, number: int, member: Member) -> tuple[Outcome, list[str]]:
    """Compute a capture on a worker, and return what became of it and the warnings."""
    observer = _Warnings()
    if member.missing is None and not os.path.lexists(member.folder):
        here = import_extra("distributed", "cluster").get_worker().address
        member = replace(
            member,
            missing=InputError(
                f"the folder does not exist on the worker {here}", path=member.folder, hint=SAME_STORAGE
            ),
        )
    outcome = run_member(member, settings.options, settings.redo, lambda: _method(settings), observer)
    return outcome, observer.found


_made: dict[tuple[str, MethodOptions, str | None], Estimator] = {}
"""The estimator of this worker; loading it takes a second."""


def _method(settings: _Settings) -> Estimator:
    options, sha256 = settings.options, settings.weights_sha256
    key = (options.method, options.method_options, sha256)
    if key not in _made:
        estimator = make_method(options)
        found = None if estimator.weights is None else estimator.weights["sha256"]
        if found != sha256:
            raise ModelError(
                f"the weights have the SHA-256 {found}, expected {sha256} as on the machine of the command",
                path=options.weights,
                hint="Use the same file, and the same version of splinecli, everywhere",
            )
        _made.clear()
        _made[key] = estimator
    return _made[key]
