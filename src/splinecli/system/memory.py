"""The memory that a process may still use, and the images that it reads into it."""

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from splinecli.errors import SplinecliError

LARGEST_IMAGE = 400_000_000  # pixels of the largest image that is read
_LIBRARIES, _BUFFER = 1.5e9, 64 * 2**20  # bytes
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # of malloc.h
_LARGEST_KEPT, _MOST_KEPT = 2**27, 2**29  # bytes
_NO_MEMORY = ("allocate memory", "out of memory", "not enough memory", "failed to map segment", "start new thread")
_GROUPS = Path("/proc/self/cgroup")  # lines "0::/group" (version 2) or "N:controllers:/group" (version 1)
_MOUNT = Path("/sys/fs/cgroup")
_GROUP_FILES = (  # the limit, the use, and the file cache within it
    ("memory.max", "memory.current", "inactive_file"),  # version 2
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),  # version 1
)


def available_memory() -> float:
    """Return the bytes of memory that this process may still use; infinity where the system does not say.

    It is the least of the machine's free memory, the limits of the process's control groups, and the limit on its
    address space (ulimit -v).
    """
    in_groups = map(_left_in_group, own_groups("memory"))
    return min(_free_memory(), _left_in_address_space(), *in_groups)


def own_groups(controller: str) -> Iterator[Path]:
    """Yield the folders of this process's control groups that limit `controller`, cpu or memory, and of those above."""
    try:
        lines = _GROUPS.read_text("utf-8").splitlines()
    except OSError:
        return  # not Linux
    for line in lines:
        _, controllers, group = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = _MOUNT / controllers
        if not top.is_dir():
            top = _MOUNT / controller
        folder = top / group.lstrip("/")
        # Inside a container the path may be that of the host, which does not exist here. The top always does.
        for place in (folder, *folder.parents):
            yield place
            if place == top:
                break


def check_address_space() -> None:
    """Raise SplinecliError if the limit on the address space (ulimit -v) is too low to load the numerical libraries.

    Where it is lower, these libraries abort without a message. They reserve a buffer for each core.
    """
    needed = _LIBRARIES + _BUFFER * (os.cpu_count() or 1)
    if (most := _address_space_limit()) < needed:
        raise SplinecliError(
            f"the limit on the memory of this process is {most / 1e9:.1f} GB (ulimit -v), but at least"
            f" {needed / 1e9:.1f} GB are needed",
            hint="Raise the limit",
        )


def keep_freed_memory() -> None:
    """Let the C library keep freed blocks for the next arrays, where it is glibc.

    By default it returns large blocks to the system, which then clears new pages for every array. That takes about a
    third of the time of networks and of reading. Blocks above _LARGEST_KEPT are still returned.
    """
    mallopt = _of_c_library("mallopt")
    for parameter, n_bytes in ((_MMAP_THRESHOLD, _LARGEST_KEPT), (_TRIM_THRESHOLD, _MOST_KEPT)):
        mallopt(parameter, n_bytes)


def return_freed_memory() -> None:
    """Return freed blocks to the system between two stages, where the C library is glibc; see keep_freed_memory."""
    _of_c_library("malloc_trim")(0)


def _of_c_library(name: str) -> Callable[..., object]:
    """Return a function of the C library, or one that does nothing where there is none of this name."""
    try:
        import ctypes

        found: Callable[..., object] = getattr(ctypes.CDLL(None), name)
    except (ImportError, OSError, AttributeError, TypeError):  # another C library, or Windows
        return lambda *_: None
    return found


def _free_memory() -> float:
    return 1024 * _value_after("MemAvailable:", Path("/proc/meminfo"), math.inf)


def _left_in_group(folder: Path) -> float:
    """Return what the limit of a control group leaves. The group's file cache can be freed.

    Without a limit it is infinity or, in version 1, a huge number.
    """
    for limit, use, cache in _GROUP_FILES:
        try:
            most, used = (int((folder / name).read_text("utf-8")) for name in (limit, use))
        except (OSError, ValueError):  # the other version, or the limit "max"
            continue
        return most - used + _value_after(cache, folder / "memory.stat", 0)
    return math.inf


def _address_space_limit() -> float:
    try:
        import resource
    except ImportError:  # Windows
        return math.inf
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return math.inf if most == resource.RLIM_INFINITY else most


def _left_in_address_space() -> float:
    return _address_space_limit() - 1024 * _value_after("VmSize:", Path("/proc/self/status"), 0)


def _value_after(name: str, path: Path, otherwise: float) -> float:
    try:
        lines = path.read_text("utf-8").splitlines()
    except OSError:  # not Linux
        return otherwise
    return next((float(line.split()[1]) for line in lines if line.startswith(name)), otherwise)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that there is no memory left, in Python, PyTorch or the loading of a library."""
    text = str(error).lower()
    return isinstance(error, MemoryError) or (
        isinstance(error, OSError | RuntimeError | ImportError) and any(words in text for words in _NO_MEMORY)
    )
