"""Items for workers in other processes, which import this file.
They note in a folder what happens.
"""

import os
import signal
import time
from pathlib import Path
from typing import Any


def double(folder: str, number: int) -> int:
    return 2 * number


def threads(folder: str, number: int) -> str:
    return os.environ["OMP_NUM_THREADS"]


def survive_an_interrupt(folder: str, number: int) -> int:
    os.kill(os.getpid(), signal.SIGINT)
    return os.getpid()


def die_of_thirteen(folder: str, number: int) -> int:
    """Return the double; a task of number 13 kills its worker."""
    with (Path(folder) / f"begun-{number}").open("a") as file:
        file.write("x")
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number


def count_neighbours(folder: str, number: int) -> int:
    """Return how many tasks run now, this one among them."""
    mark = Path(folder) / f"running-{number}"
    mark.touch()
    time.sleep(0.05)
    running = len(list(Path(folder).glob("running-*")))
    mark.unlink()
    return running


async def set_resources(dask_worker: Any, **resources: float) -> None:
    await dask_worker.set_resources(**resources)
