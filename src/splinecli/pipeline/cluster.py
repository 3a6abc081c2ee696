"""Tasks on other processes: those of this machine, or the workers of a Dask cluster.

Each worker has at most one task at a time, so it is known which task a lost worker was doing.
"""

from __future__ import annotations

import math
import time
import uuid
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from splinecli.errors import SplinecliError, UsageError
from splinecli.pipeline.connection import ClusterOptions, workers_without_splinecli
from splinecli.pipeline.observer import Observer
from splinecli.pipeline.tasks import LostError, Task
from splinecli.pipeline.worker import SAME_VERSIONS, Work, do_task, prepare_worker, with_worker

if TYPE_CHECKING:
    from distributed import Client, Future

_LOOK_SECONDS = 1.0  # between two looks at which workers there are
_ANSWER_SECONDS = 60.0  # that the first tasks wait for workers that do not answer
_MOST_LOST_EARLY = 10  # workers that may be lost while they get ready


@dataclass
class _Worker:
    address: str
    host: str
    limit: float  # bytes
    has_memory_resource: bool
    ready: bool = False
    future: Future | None = None
    task: Task | None = None


@dataclass
class Distributor:
    """Gives tasks to workers, and those of lost workers to others.

    Workers may come and go. A new one is asked first whether it has the same versions, storage and weights.

    Args:
        client: see connected.
        work: what all tasks share.
        options: of the cluster.
        observer: receives what is wrong with workers that come later.
    """

    client: Client
    work: Work
    options: ClusterOptions
    observer: Observer
    _workers: dict[str, _Worker] = field(default_factory=dict)
    _refused: set[str] = field(default_factory=set)
    _free_memory: dict[str, float] = field(default_factory=dict)  # by host, bytes
    _again: deque[Task] = field(default_factory=deque)
    _given_up: deque[tuple[Task, LostError]] = field(default_factory=deque)
    _done: SimpleQueue[str] = field(default_factory=SimpleQueue)  # addresses
    _looked: float = -math.inf
    _seen: float = field(default_factory=time.monotonic)  # when there were workers
    _lost_early: int = 0
    _has_begun: bool = False
    _said_waiting: bool = False

    @property
    def running(self) -> int:
        """The number of tasks that workers are doing."""
        return sum(worker.task is not None for worker in self._workers.values())

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Any]]:
        """Yield each task with its result as it ends, or with a LostError.

        Raises:
            SplinecliError: what a task raised, or what is wrong with a worker. The message names the worker.
            SplinecliError: the scheduler was lost.
        """
        began = time.monotonic()
        source, following = iter(tasks), None
        while True:
            self._look_around()
            if not self._workers:
                began = time.monotonic()  # the wait for answers begins with the first worker
            asked = sum(not worker.ready for worker in self._workers.values())
            self._has_begun |= bool(self._workers) and (
                not asked or time.monotonic() - began > _ANSWER_SECONDS
            )
            while self._has_begun:
                following = following or (self._again.popleft() if self._again else next(source, None))
                if following is None:
                    break
                if not self._is_too_large(following):
                    worker = self._choose(following)
                    if worker is None:
                        break
                    self._give(worker, following)
                following = None
            while self._given_up:
                yield self._given_up.popleft()
            if self._has_begun and following is None and not self.running and not self._again:
                return
            yield from self._take_results()

    def _look_around(self) -> None:
        """Notice lost workers and new ones. Raises SplinecliError if the scheduler is lost."""
        if time.monotonic() - self._looked < _LOOK_SECONDS:
            return
        try:
            found = dict(self.client.scheduler_info(n_workers=-1)["workers"])
        except (OSError, TimeoutError, RuntimeError) as error:
            raise self._scheduler_lost() from error
        if self.client.status != "running":
            raise self._scheduler_lost()
        self._looked = time.monotonic()
        for address in self._workers.keys() - found.keys():
            self._lose(self._workers.pop(address))
        self._refused &= found.keys()
        fitting = {address for address, info in found.items() if self._has_gpu(info)}
        new = fitting - self._workers.keys() - self._refused
        for address in workers_without_splinecli(self.client, new):
            problem = f"splinecli is not installed on the worker {address}"
            self._refuse(address, UsageError(problem, hint=SAME_VERSIONS))
            new.remove(address)
        for address in new:
            self._ask(address, found[address])
        if found and not fitting and not self._has_begun:
            raise UsageError(
                "no worker has the Dask resource GPU",
                hint="Start the workers of machines with a GPU with 'dask worker ADDRESS --resources GPU=1'",
            )
        if found:
            self._seen = self._looked
        elif (self._lost_early or not self.options.address) and self._looked - self._seen > _ANSWER_SECONDS:
            raise self._ended_early()
        elif not self._said_waiting:
            self._said_waiting = True
            self.observer.say("waiting for workers")

    def _ask(self, address: str, info: dict[str, Any]) -> None:
        """Let a new worker get ready."""
        resources = info.get("resources") or {}
        limit = resources.get("MEMORY") or info.get("memory_limit") or math.inf
        worker = _Worker(address, info.get("host") or address, limit, "MEMORY" in resources)
        self._workers[address] = worker
        self._make_probe()
        self._submit(worker, prepare_worker, self.work)

    def _has_gpu(self, info: dict[str, Any]) -> bool:
        """Return whether a worker has the GPU that the tasks need, if they need one."""
        return not self.options.gpu or (info.get("resources") or {}).get("GPU", 0) >= 1

    def _make_probe(self) -> None:
        """Make the file by which workers know the output folder. Another command may have removed it."""
        Path(self.work.probe).touch()

    def _choose(self, task: Task) -> _Worker | None:
        """Return an idle worker with enough memory. A machine without any task takes a task of any size."""
        used: defaultdict[str, float] = defaultdict(float)
        for worker in self._workers.values():
            used[worker.host] += worker.task.memory if worker.task else 0.0
        for worker in self._workers.values():
            if worker.ready and worker.task is None and task.memory <= worker.limit:
                others = used[worker.host]
                if not others or others + task.memory <= self._free_memory[worker.host]:
                    return worker
        return None

    def _is_too_large(self, task: Task) -> bool:
        """Give a task up that takes more memory than any worker has."""
        largest = max((worker.limit for worker in self._workers.values()), default=math.inf)
        if task.memory <= largest:
            return False
        problem = f"it takes about {task.memory / 1e9:.1f} GB of memory, but the largest worker has"
        error = LostError(
            f"{problem} {largest / 1e9:.1f} GB",
            path=task.name,
            hint="Start fewer workers on each machine, with more memory each",
        )
        self._given_up.append((task, error))
        return True

    def _give(self, worker: _Worker, task: Task) -> None:
        worker.task = task
        self._submit(worker, do_task, self.work, *task.args, memory=task.memory)

    def _submit(self, worker: _Worker, function: Any, *args: Any, memory: float = 0.0) -> None:
        resources = {"GPU": 1.0} if self.options.gpu else {}
        if worker.has_memory_resource:
            resources["MEMORY"] = memory
        try:
            worker.future = self.client.submit(
                function,
                *args,
                key=f"splinecli-{uuid.uuid4().hex}",
                workers=[worker.address],
                resources=resources or None,
                pure=False,
            )
        except (OSError, RuntimeError) as error:
            raise self._scheduler_lost() from error
        worker.future.add_done_callback(lambda _, address=worker.address: self._done.put(address))

    def _lose(self, worker: _Worker) -> None:
        if worker.future is not None:
            worker.future.release()
        if not worker.ready:
            self._lost_early += 1
            if self._lost_early > _MOST_LOST_EARLY:
                raise self._ended_early()
        task = worker.task
        if task is None:
            return
        task.losses += 1
        if task.losses <= self.options.retries:
            self._again.append(task)
            return
        times = "once" if task.losses == 1 else f"{task.losses} times"
        error = LostError(
            f"its worker was lost {times}, the last one {worker.address}",
            path=task.name,
            hint="If there was too little memory, start fewer workers on each machine, or make the images smaller",
        )
        self._given_up.append((task, error))

    def _take_results(self) -> Iterator[tuple[Task, Any]]:
        """Wait a moment for results, and yield those that there are."""
        addresses = []
        with suppress(Empty):
            addresses.append(self._done.get(timeout=_LOOK_SECONDS / 2))
            while True:
                addresses.append(self._done.get_nowait())
        for address in addresses:
            worker = self._workers.get(address)
            if worker is not None and worker.future is not None and worker.future.done():
                yield from self._take_result(worker, worker.future)

    def _take_result(self, worker: _Worker, future: Future) -> Iterator[tuple[Task, Any]]:
        from distributed.scheduler import KilledWorker

        if future.cancelled():
            raise self._scheduler_lost()
        try:
            result = future.result(timeout=_LOOK_SECONDS)
        except TimeoutError:
            if future.status == "error":  # of the task itself
                raise
            self._done.put(worker.address)  # if the worker is lost now, _look_around sees that
            return
        except KilledWorker:
            self._lose(self._workers.pop(worker.address))
            return
        except SplinecliError as error:
            named = with_worker(error, worker.address)
            if worker.ready:
                raise named from error
            del self._workers[worker.address]
            self._refuse(worker.address, named)
            return
        except Exception as error:
            if worker.ready:
                raise
            # Even the first task cannot be read there.
            reason = f"{type(error).__name__}: {error}"
            raise UsageError(
                f"the worker {worker.address}, or the scheduler, cannot run splinecli ({reason})",
                hint=SAME_VERSIONS,
            ) from error
        worker.future, task, worker.task = None, worker.task, None
        if task is not None:
            yield task, result
            return
        worker.ready, self._lost_early = True, 0
        self._free_memory.setdefault(worker.host, result)

    def _refuse(self, address: str, error: SplinecliError) -> None:
        """Give a worker no work. Raises the error if nothing has been computed yet."""
        if not self._has_begun:
            raise error
        self._refused.add(address)
        self.observer.warn(f"{error} This worker gets no work")

    def _ended_early(self) -> SplinecliError:
        return SplinecliError(
            "the workers end while they are getting ready",
            hint="If there is too little memory, use fewer. Dask's output says more",
        )

    def _scheduler_lost(self) -> SplinecliError:
        return SplinecliError(
            "the connection to the Dask scheduler was lost",
            hint="Run the same command again. It skips what is done",
        )
