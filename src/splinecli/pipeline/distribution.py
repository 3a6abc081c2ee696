"""Map a function over items in other processes, on this machine or on a Dask cluster.

Workers receive paths and return reports; arrays are never transferred. If a worker is lost, Dask
repeats its item.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock
from typing import TYPE_CHECKING, Any

from splinecli._version import __version__
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.pipeline.infer_options import ClusterOptions
from splinecli.system.files import UNFINISHED, made_folder, read_json, refusals_as_output_errors
from splinecli.system.machine import (
    available_memory,
    count_available_cores,
    count_chosen_cores,
    import_extra,
    keep_freed_memory,
)
from splinecli.system.progress import Observer
from splinecli.system.publishing import locked_file

if TYPE_CHECKING:
    from distributed import Client, Future


# timeouts for a scheduler's answers
CONNECT_SECONDS, ANSWER_SECONDS, CLOSE_SECONDS = (5.0, 6.0, 5.0)
_LOOK_SECONDS = 0.5  # between two updates of the list of workers
# A worker processes one item at a time, because the working folder and PyTorch's threads are shared
# by the whole process.
_ONE_AT_A_TIME = Lock()
SAME_STORAGE = "Workers must access this machine's storage under the same path, for example by NFS"
SAME_VERSIONS = "Install the same versions on all workers and the scheduler"


@contextmanager
def connected(options: ClusterOptions) -> Iterator[Client]:
    """Yield a Dask client of a new cluster on this machine, or of a running cluster.

    Raises UsageError if Dask is not installed, or if no scheduler answers at the address.
    """
    distributed = import_extra("distributed", "cluster")
    if options.address is None:
        with (
            _local_cluster(options) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,
        ):
            yield client
        return
    client = _client(_address(options.address))
    try:
        yield client
    finally:
        with suppress(OSError, TimeoutError):
            client.close(timeout=CLOSE_SECONDS)


def _client(address: str) -> Client:
    """Return a client of the scheduler at the address. Raises UsageError."""
    from distributed import Client, rpc

    async def identify() -> Any:
        async with rpc(address, timeout=CONNECT_SECONDS) as server:
            return await asyncio.wait_for(server.identity(), ANSWER_SECONDS)

    # The server is identified first, because a client waits forever for a server that is not a
    # scheduler, and a client that fails to start can block Dask's event loop when Python deletes
    # it. This runs in a separate thread, because the current one may already have an event loop.
    try:
        with ThreadPoolExecutor(1) as thread:
            identity = thread.submit(asyncio.run, identify()).result()
        if identity["type"] != "Scheduler":
            raise ValueError(f"a {identity['type']} answers at {address}")
        return Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except Exception as error:
        raise UsageError(
            f"no Dask scheduler answers at {address}",
            hint="Start one with 'dask scheduler', and workers with 'dask worker ADDRESS'",
        ) from error


@contextmanager
def _local_cluster(options: ClusterOptions) -> Iterator[Any]:
    """Yield a Dask cluster of processes on this machine, each with its share of the cores."""
    import dask
    from distributed import LocalCluster

    threads = max(1, min(count_available_cores() // options.workers, count_chosen_cores()))
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    environment = dict.fromkeys(names, str(threads))
    parts = ("client", "worker", "scheduler")
    loggers = ("distributed", *(f"distributed.{part}" for part in parts), "tornado")
    settings: dict[str, Any] = {
        "distributed.nanny.pre-spawn-environ": environment,
        # Do not collect data for a dashboard, which takes processor time and memory.
        "distributed.admin.low-level-log-length": 100,
        "distributed.admin.system-monitor.log-length": 10,
        "distributed.admin.system-monitor.interval": "10s",
        "distributed.admin.tick.interval": "1s",
        "distributed.scheduler.active-memory-manager.start": False,
        "distributed.scheduler.work-stealing": False,
        "distributed.worker.profile.enabled": False,
        # If a worker is lost, its item is retried twice. A running cluster has its own setting.
        "distributed.scheduler.allowed-failures": 2,
        # A terminal also sends Ctrl-C to the workers, but only the command should stop them.
        "distributed.worker.preload": [
            "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)"
        ],
        "logging": dict.fromkeys(loggers, "critical"),
        # On a busy machine, a restarted worker may need more time than Dask allows by default.
        "distributed.deploy.lost-worker-timeout": "1 h",
    }
    with dask.config.set(settings):
        try:
            cluster = LocalCluster(
                n_workers=options.workers,
                threads_per_worker=1,
                env=environment,  # overrides the numbers in the user's environment
                memory_limit=0,  # Distributor divides the machine's free memory
                resources={"GPU": 1} if options.gpu else None,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:  # possibly caused by an error of the operating system
            cause: BaseException | None = error
            while cause is not None and not isinstance(cause, OSError):
                cause = cause.__cause__
            reason = "" if cause is None else f" ({cause.strerror or cause})"
            raise SplinecliError(
                f"the processes of --workers cannot be started{reason}",
                hint="Leave --workers out, or raise the limits: each process needs a temporary"
                " folder and 50 open files",
            ) from error
        try:
            yield cluster
        finally:
            cluster.close(timeout=CLOSE_SECONDS)


def _address(text: str) -> str:
    """Return the address of a scheduler, reading the scheduler file if one is given.

    Raises UsageError.
    """
    from distributed.comm.registry import backends

    scheme, separator, _ = text.partition("://")
    if separator and scheme in backends:
        return text
    try:
        return str(read_json(Path(text))["address"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(
            f"--cluster is {text}; expected an address such as tcp://scheduler:8786, or a"
            " scheduler file",
            hint="Write a scheduler file with 'dask scheduler --scheduler-file FILE'",
        ) from None


class LostError(SplinecliError):
    """An item failed because its worker was lost or has too little memory. Other items may
    succeed.
    """


@dataclass(frozen=True)
class WorkItem:
    """The arguments of Work.do, a name for messages, and the required memory in bytes."""

    args: tuple[Any, ...]
    name: str
    memory: float = 0.0


def _versions() -> dict[str, str]:
    return {"splinecli": __version__, "distributed": metadata.version("distributed")}


@dataclass(frozen=True)
class Work:
    """The settings shared by all items of a command, which are sent with each item."""

    # returns the result for the arguments of an item, or raises an error about the worker
    do: Callable[..., Any]
    probe: str  # a file in the output folder; a worker that cannot find it uses other storage
    # working folder of the command, which relative paths refer to
    folder: str = field(default_factory=os.getcwd)
    versions: dict[str, str] = field(default_factory=_versions)  # package versions that must match

    def enter(self) -> None:
        """Prepare this worker.

        Raises UsageError or InputError if it is incompatible with the command.
        """
        for package, found in _versions().items():
            if found != (expected := self.versions[package]):
                raise UsageError(
                    f"found {package} {found}, expected {expected} as on the command's machine",
                    hint=SAME_VERSIONS,
                )
        try:
            os.chdir(self.folder)
        except OSError as error:
            raise InputError(
                f"the folder cannot be entered ({error.strerror})",
                path=self.folder,
                hint=SAME_STORAGE,
            ) from None
        deadline = time.monotonic() + 3.0  # a new file may appear on a network drive with a delay
        while not (probe := Path(self.probe)).exists():
            if not probe.parent.exists() or time.monotonic() > deadline:
                raise InputError(
                    "the worker's folder is not the folder of the command's machine",
                    path=probe.parent,
                    hint=SAME_STORAGE,
                )
            time.sleep(0.1)
        keep_freed_memory()


def this_worker() -> str:
    """Return the address of the worker that this code runs on."""
    return str(import_extra("distributed", "cluster").get_worker().address)


def _do(work: Work, *args: Any) -> Any:
    """Process an item on a worker and return its result. Error messages contain the worker's
    address.
    """
    try:
        with _ONE_AT_A_TIME:
            work.enter()
            return work.do(*args)
    except SplinecliError as error:
        raise type(error)(
            f"{error.problem} (on the worker {this_worker()})",
            path=error.path,
            line=error.line,
            hint=error.hint,
        ) from None


@dataclass
class Distributor:
    """Assigns items to the workers of a Dask cluster, one at a time to each worker.

    Workers may join and leave.
    """

    client: Client
    work: Work
    options: ClusterOptions
    observer: Observer
    running: dict[Future, WorkItem] = field(default_factory=dict)
    _done: SimpleQueue[Future] = field(default_factory=SimpleQueue)

    def run(self, items: Iterable[WorkItem]) -> Iterator[tuple[WorkItem, Any]]:
        """Yield each item with its result, or with a LostError, as soon as it is done.

        Raises SplinecliError, also if the scheduler is lost. The message contains the worker's
        address.
        """
        # A worker without splinecli could not even unpickle an item.
        for address, found in self.client.run(
            metadata.version, "splinecli", on_error="return"
        ).items():
            if isinstance(found, metadata.PackageNotFoundError):
                raise UsageError(
                    f"splinecli is not installed on the worker {address}", hint=SAME_VERSIONS
                )
        if not self._workers():
            self.observer.say("waiting for workers")
        source = iter(items)
        following = next(source, None)
        free_memory, began = available_memory(), time.monotonic()
        while self.running or following is not None:
            workers = self._workers()
            if workers:
                began = time.monotonic()
            # A cluster on this machine is considered lost after a minute.
            elif not self.options.address and time.monotonic() - began > 60.0:
                raise SplinecliError(
                    "the workers stop before they are ready",
                    hint="If memory is short, use fewer workers. Dask's output has the details",
                )
            while following is not None and len(self.running) < len(workers):
                limits = (
                    _resources(info).get("MEMORY") or info.get("memory_limit")
                    for info in workers.values()
                )
                largest = max(float(limit or math.inf) for limit in limits)
                # The workers of a cluster have Dask's memory limits, whereas local workers share
                # this machine's memory.
                used = (
                    0.0
                    if self.options.address
                    else sum(item.memory for item in self.running.values())
                )
                if following.memory > largest:
                    error = LostError(
                        f"it takes about {following.memory / 1e9:.1f} GB of memory, but the"
                        f" largest worker has only {largest / 1e9:.1f} GB",
                        path=following.name,
                        hint="Start fewer workers on each machine, with more memory each",
                    )
                    yield following, error
                elif not used or used + following.memory <= free_memory:
                    self._submit(following, workers)
                else:
                    break
                following = next(source, None)
            with suppress(Empty):
                yield from self._take_result(self._done.get(timeout=_LOOK_SECONDS))

    def _workers(self) -> dict[str, dict[str, Any]]:
        """Return Dask's information about the usable workers.

        Raises SplinecliError if the scheduler is lost.
        """
        try:
            found = dict(self.client.scheduler_info(n_workers=-1)["workers"])
        except (OSError, TimeoutError, RuntimeError) as error:
            raise _scheduler_lost() from error
        if self.client.status != "running":
            raise _scheduler_lost()
        if not self.options.gpu:
            return found
        with_gpu = {
            address: info for address, info in found.items() if _resources(info).get("GPU", 0) >= 1
        }
        if found and not with_gpu and not self.running:
            raise UsageError(
                "no worker has the Dask resource GPU",
                hint="On machines with a GPU, start workers with 'dask worker ADDRESS --resources"
                " GPU=1'",
            )
        return with_gpu

    def _submit(self, item: WorkItem, workers: dict[str, dict[str, Any]]) -> None:
        needed = {"GPU": 1.0} if self.options.gpu else {}
        if any("MEMORY" in _resources(info) for info in workers.values()):
            needed["MEMORY"] = item.memory
        key, resources = f"splinecli-{uuid.uuid4().hex}", needed or None
        try:
            future = self.client.submit(
                _do, self.work, *item.args, key=key, resources=resources, pure=False
            )
        except (OSError, RuntimeError) as error:
            raise _scheduler_lost() from error
        self.running[future] = item
        future.add_done_callback(self._done.put)

    def _take_result(self, future: Future) -> Iterator[tuple[WorkItem, Any]]:
        from distributed.scheduler import KilledWorker

        if future.cancelled():
            raise _scheduler_lost()
        item = self.running[future]
        try:
            result = future.result(timeout=_LOOK_SECONDS)
        except TimeoutError:
            if future.status == "error":  # the item itself failed
                raise
            # The worker was lost with its result, so Dask repeats the item.
            future.add_done_callback(self._done.put)
            return
        except KilledWorker as error:
            last = getattr(error.last_worker, "address", error.last_worker)
            result = LostError(
                f"its worker was lost {error.allowed_failures + 1} times, the last one {last}",
                path=item.name,
                hint="If memory was short, start fewer workers on each machine, or reduce the"
                " images",
            )
        del self.running[future]
        yield item, result


def _resources(info: dict[str, Any]) -> dict[str, float]:
    return info.get("resources") or {}


def _scheduler_lost() -> SplinecliError:
    return SplinecliError(
        "the connection to the Dask scheduler was lost",
        hint="Run the same command again. It skips captures that are already done",
    )


@contextmanager
def distributor(
    do: Callable[..., Any], output: Path, options: ClusterOptions, observer: Observer
) -> Iterator[Distributor]:
    """Yield a Distributor that is connected to its workers.

    Raises UsageError as `connected` does, or OutputError. The output folder is created if needed,
    because it serves to check that the workers use the same storage.
    """
    probe = output / f".{uuid.uuid4().hex}{UNFINISHED}"
    with ExitStack() as stack:
        with refusals_as_output_errors(output):
            stack.enter_context(made_folder(output))
            # Without a lock, another batch would remove the file as a leftover of a killed process.
            stack.enter_context(locked_file(probe, wait=True))
        client = stack.enter_context(connected(options))
        yield Distributor(client, Work(do, str(probe.absolute())), options, observer)
