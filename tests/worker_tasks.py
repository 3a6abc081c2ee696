"""Items for workers in other processes, which import this file.
They note in a folder what happens.
"""

import os
import signal
import time
from pathlib import Path


def double(folder, number):
    return 2 * number


def threads(folder, number):
    return os.environ["OMP_NUM_THREADS"]


def survive_an_interrupt(folder, number):
    os.kill(os.getpid(), signal.SIGINT)
    return os.getpid()


def die_of_thirteen(folder, number):
    """Return the double; a task of number 13 kills its worker."""
    with (Path(folder) / f"begun-{number}").open("a") as file:
        file.write("x")
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number


def count_neighbours(folder, number):
    """Return how many tasks run now, this one among them."""
    mark = Path(folder) / f"running-{number}"
    mark.touch()
    time.sleep(0.05)
    running = len(list(Path(folder).glob("running-*")))
    mark.unlink()
    return running


async def set_resources(dask_worker, **resources):
    await dask_worker.set_resources(**resources)
