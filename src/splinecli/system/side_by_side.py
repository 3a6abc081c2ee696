"""Parts of a computation on all cores, each in a thread of its own."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")

_lock, _users, _threads = Lock(), 0, 0


@contextmanager
def one_thread_each() -> Iterator[int]:
    """Let each operation of PyTorch use one thread only. Yields the number of threads that it used before.

    Operations on small arrays are hardly faster on more, and on a busy machine many times as slow, because all threads
    of an operation wait for the slowest.
    """
    import torch

    global _users, _threads
    # Each thread has its own number, and new ones have the number that was set last. So the first of several callers
    # reads it for all, and each sets it in its own thread.
    with _lock:
        if not _users:
            _threads = torch.get_num_threads()
        _users += 1
        threads = _threads
        torch.set_num_threads(1)
    try:
        yield threads
    finally:
        with _lock:
            _users -= 1
            torch.set_num_threads(threads)


def side_by_side(function: Callable[[Part], Result], parts: Iterable[Part]) -> Iterator[Result]:
    """Yield function(part) of each part, in order, computed without gradients on as many threads as PyTorch uses.

    Within the function, each operation of PyTorch uses one thread. At most one result more than there are threads is
    kept. An error is raised when the turn of its part comes.
    """
    import torch

    def compute(part: Part) -> Result:
        with torch.inference_mode():
            return function(part)

    waiting: deque[Future[Result]] = deque()
    with one_thread_each() as threads:
        # Each new thread has the number of threads of OpenMP, until PyTorch sets its own.
        pool = ThreadPoolExecutor(threads, "part", lambda: torch.set_num_threads(1))
        try:
            for part in parts:
                waiting.append(pool.submit(compute, part))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
