"""The connection to a Dask cluster: one that runs already, or one of processes of this machine."""

from __future__ import annotations

import asyncio
import logging
import os
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splinecli.errors import SplinecliError, UsageError
from splinecli.system.files import read_json
from splinecli.system.machine import count_available_cores, import_extra

if TYPE_CHECKING:
    from distributed import Client

RETRIES = 2  # of an item whose worker of this machine was lost; a running cluster has a setting of its own
_CONNECT_SECONDS = 5.0
_ANSWER_SECONDS = 6.0  # that a server may take to answer as a scheduler does
_CLOSE_SECONDS = 5.0
_LOGGERS = ("distributed", "distributed.client", "distributed.worker", "distributed.scheduler", "tornado")

# A terminal sends Ctrl-C to the workers, too. The command ends them.
_IGNORE_INTERRUPTS = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)"

_QUIET = {
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.system-monitor.log-length": 10,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.tick.interval": "1s",
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.scheduler.work-stealing": False,
    "distributed.worker.profile.enabled": False,
}
"""Settings of Dask without what serves its dashboard only. It would take processor time, and memory for an hour."""


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """Where items are done."""

    workers: int = 1  # the number of processes of this machine, if there is no `address`. 0 for as many as it can use.
    address: str | None = None  # the address of a Dask scheduler, or its scheduler file
    gpu: bool = False  # whether only workers with the Dask resource GPU are used

    def on_cores(self, n_items: int | None = None) -> ClusterOptions | None:
        """Return these options with a process for each core in place of 0, and at most one for each item.

        Return None where this process can do the items as well.
        """
        if self.address is not None:
            return self
        workers = self.workers or count_available_cores()
        if n_items is not None:
            workers = min(workers, n_items)
        return None if workers < 2 else replace(self, workers=workers)


@contextmanager
def connected(options: ClusterOptions) -> Iterator[Client]:
    """Yield a Dask client: of a new cluster of this machine's processes, or of a running one.

    Raises UsageError if Dask is not installed, or there is no scheduler at the address.
    """
    distributed = import_extra("distributed", "cluster")
    for name in _LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", category=distributed.versions.VersionMismatchWarning)
    if options.address is None:
        with _local_cluster(options) as cluster, distributed.Client(cluster, set_as_default=False) as client:
            yield client
        return
    client = _client(_address(options.address))
    try:
        yield client
    finally:
        with suppress(OSError, TimeoutError):
            client.close(timeout=_CLOSE_SECONDS)


def _client(address: str) -> Client:
    """Return a client of the scheduler at the address. Raises UsageError."""
    from distributed import Client, rpc

    async def identify() -> Any:
        async with rpc(address, timeout=_CONNECT_SECONDS) as server:
            return await asyncio.wait_for(server.identity(), _ANSWER_SECONDS)

    # A client waits for ever for a server that is no scheduler. One that fails to start can block Dask's event loop
    # when Python deletes it. For this reason, the server says first what it is, in a thread: this one may have a loop.
    try:
        with ThreadPoolExecutor(1) as thread:
            identity = thread.submit(asyncio.run, identify()).result()
        if identity["type"] != "Scheduler":
            raise ValueError(f"a {identity['type']} answers at {address}")
        return Client(address, timeout=_CONNECT_SECONDS, set_as_default=False)
    except Exception as error:
        raise UsageError(
            f"no Dask scheduler answers at {address}",
            hint="Start one with 'dask scheduler', and workers with 'dask worker ADDRESS'",
        ) from error


@contextmanager
def _local_cluster(options: ClusterOptions) -> Iterator[Any]:
    """Yield a Dask cluster of processes of this machine, each with its share of the cores."""
    import dask
    from distributed import LocalCluster

    of_user = os.environ.get("OMP_NUM_THREADS", "")
    threads = count_available_cores() // options.workers
    threads = max(1, min(threads, int(of_user)) if of_user.isdecimal() else threads)
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    environment = dict.fromkeys(names, str(threads))
    settings: dict[str, Any] = {
        "distributed.nanny.pre-spawn-environ": environment,
        **_QUIET,
        "distributed.scheduler.allowed-failures": RETRIES,
        "distributed.worker.preload": [_IGNORE_INTERRUPTS],
        "logging": dict.fromkeys(_LOGGERS, "critical"),
        # On a busy machine, a worker that is started anew may need longer than Dask waits before it gives it up.
        "distributed.deploy.lost-worker-timeout": "1 h",
    }
    _start_resource_tracker()
    with dask.config.set(settings):
        try:
            cluster = LocalCluster(
                n_workers=options.workers,
                threads_per_worker=1,
                env=environment,  # also where the user's environment has other numbers
                memory_limit=0,  # what is free on the machine is shared out by Distributor
                resources={"GPU": 1} if options.gpu else None,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:  # Dask's, of which a cause may be what the system refused
            cause: BaseException | None = error
            while cause is not None and not isinstance(cause, OSError):
                cause = cause.__cause__
            reason = "" if cause is None else f" ({cause.strerror or cause})"
            raise SplinecliError(
                f"the processes of --workers cannot be started{reason}",
                hint="Leave --workers out, or raise the limits: each needs a temporary folder and 50 open files",
            ) from error
        try:
            yield cluster
        finally:
            cluster.close(timeout=_CLOSE_SECONDS)


def _start_resource_tracker() -> None:
    """Start the process in which Python counts semaphores, without its warning: SIGTERM may end this process first."""
    if os.name == "nt":  # where there is no such process
        return
    before = os.environ.get("PYTHONWARNINGS", "")
    os.environ["PYTHONWARNINGS"] = "ignore"
    try:
        resource_tracker.ensure_running()
    finally:
        os.environ["PYTHONWARNINGS"] = before


def _address(text: str) -> str:
    """Return the address of a scheduler, which may be in a scheduler file. Raises UsageError."""
    from distributed.comm.registry import backends

    scheme, separator, _ = text.partition("://")
    if separator and scheme in backends:
        return text
    try:
        return str(read_json(Path(text))["address"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(
            f"--cluster is {text}; expected an address such as tcp://scheduler:8786, or a scheduler file",
            hint="'dask scheduler --scheduler-file FILE' writes such a file",
        ) from None
