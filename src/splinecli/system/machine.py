"""The machine: memory, devices, number formats, threads, and optional packages."""

from __future__ import annotations

import importlib
import math
import os
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from types import ModuleType
from typing import TYPE_CHECKING, Literal, TypeVar

from splinecli.errors import SplinecliError, UsageError

if TYPE_CHECKING:
    import torch

# Messages by extra
_PROBLEMS = {
    "cluster": "--workers above 1 and --cluster need the package distributed,"
    " which is not installed",
    "exr": "EXR files need the package OpenEXR, which is not installed",
    "heif": "HEIC images need the package pillow-heif, which is not installed",
    "mesh": "--decimate needs the package fast-simplification, which is not installed",
    "raw": "camera RAW files need rawpy, which is not installed",
    "render": "rendering needs embreex and scikit-image, which are not all installed",
    "tensorboard": "--tensorboard needs the package tensorboard, which is not installed",
}


def import_extra(
    module: str,
    extra: str,
    *,
    error: type[SplinecliError] = UsageError,
    path: Path | None = None,
    otherwise: str | None = None,
) -> ModuleType:
    """Return a module of an extra (a key of _PROBLEMS), imported when it is first used.

    Raises UsageError or `error` if the module is not installed. The message contains the command
    that installs it, the file at `path` that cannot be read without it, and `otherwise`, an
    alternative.
    """
    try:
        return importlib.import_module(module)
    except ImportError as cause:
        alternative = f", or {otherwise}" if otherwise else ""
        raise error(
            _PROBLEMS[extra], path, hint=f"Run pip install 'splinecli[{extra}]'{alternative}"
        ) from cause


LARGEST_IMAGE = 400_000_000  # pixels of the largest image that is read
# Contains lines "0::/group" (version 2) or "N:controllers:/group" (version 1)
GROUPS = Path("/proc/self/cgroup")
MOUNT = Path("/sys/fs/cgroup")
_GROUP_FILES = (  # the limit, the usage, and the file cache, which is part of the usage
    ("memory.max", "memory.current", "inactive_file"),  # version 2
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),  # version 1
)


def available_memory() -> float:
    """Return the number of bytes that this process may still allocate; infinity if it is unknown.

    It is the minimum of the machine's free memory, the limits of the process's control groups, and
    the limit on its address space (ulimit -v).
    """
    in_groups = map(_left_in_group, own_groups("memory"))
    return min(free_memory(), left_in_address_space(), *in_groups)


def own_groups(controller: str) -> Iterator[Path]:
    """Yield the folders of this process's control groups, and of their parents, that limit
    `controller`.

    The controller is cpu or memory.
    """
    try:
        lines = GROUPS.read_text("utf-8").splitlines()
    except OSError:
        return  # not Linux
    for line in lines:
        _, controllers, group = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = MOUNT / controllers
        if not top.is_dir():
            top = MOUNT / controller
        folder = top / group.lstrip("/")
        # In a container, this may be a path on the host, which does not exist here. The top always
        # exists.
        for place in (folder, *folder.parents):
            yield place
            if place == top:
                break


def check_address_space() -> None:
    """Raise SplinecliError if the limit on the address space (ulimit -v) is too low for the
    libraries.

    The numerical libraries reserve a buffer for each core, and abort without a message if this
    fails.
    """
    needed = 1.5e9 + 64 * 2**20 * (os.cpu_count() or 1)
    if (most := _address_space_limit()) < needed:
        raise SplinecliError(
            f"the memory limit of this process is {most / 1e9:.1f} GB (ulimit -v), but at least"
            f" {needed / 1e9:.1f} GB are needed",
            hint="Raise the limit",
        )


def keep_freed_memory() -> None:
    """Let the C library keep freed blocks for the next arrays, if it is glibc.

    By default, it returns large blocks to the system, which clears new pages for every array. This
    takes about a third of the time for networks and for reading. Blocks above 128 MiB are still
    returned.
    """
    mallopt = _of_c_library("mallopt")
    mallopt(-3, 2**27)  # M_MMAP_THRESHOLD of malloc.h: the largest block that is kept
    mallopt(-1, 2**29)  # M_TRIM_THRESHOLD: the most memory that is kept


def return_freed_memory() -> None:
    """Return freed blocks to the system between two stages, if the C library is glibc.

    See keep_freed_memory.
    """
    _of_c_library("malloc_trim")(0)


def _of_c_library(name: str) -> Callable[..., object]:
    """Return a function of the C library, or one that does nothing if the library does not have
    it.
    """
    try:
        import ctypes

        found: Callable[..., object] = getattr(ctypes.CDLL(None), name)
    except (ImportError, OSError, AttributeError, TypeError):  # another C library, or Windows
        return lambda *_: None
    return found


def free_memory() -> float:
    return 1024 * _value_after("MemAvailable:", Path("/proc/meminfo"), math.inf)


def _left_in_group(folder: Path) -> float:
    """Return the bytes left under the limit of a control group, including its file cache.

    Without a limit, it is infinity or, in version 1, a huge number.
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


def left_in_address_space() -> float:
    return _address_space_limit() - 1024 * _value_after("VmSize:", Path("/proc/self/status"), 0)


def _value_after(name: str, path: Path, otherwise: float) -> float:
    try:
        lines = path.read_text("utf-8").splitlines()
    except OSError:  # not Linux
        return otherwise
    return next((float(line.split()[1]) for line in lines if line.startswith(name)), otherwise)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means that memory ran out in Python, in PyTorch or while loading a
    library.
    """
    text, of_library = str(error).lower(), isinstance(error, OSError | RuntimeError | ImportError)
    known = (
        "allocate memory",
        "out of memory",
        "not enough memory",
        "failed to map segment",
        "start new thread",
    )
    return isinstance(error, MemoryError) or (of_library and any(words in text for words in known))


Device = Literal["auto", "cpu", "cuda"]
NumberFormat = Literal["float32", "bfloat16"]
Precision = Literal["auto", "float32", "bfloat16"]


def choose_device(name: Device | str) -> torch.device:
    """Return the device with this name; "auto" is a CUDA GPU if there is one, otherwise the CPU.

    Raises UsageError.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise UsageError(f"no device named {name!r}; expected auto, cpu or cuda")
    import torch

    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UsageError("no CUDA device was found", hint="Use --device cpu or auto")
    return torch.device("cuda" if available and name != "cpu" else "cpu")


_HAS_BFLOAT16 = re.compile("(?i)(|ALL|DEFAULT)$|AVX512_CORE_(BF16|FP16|AMX)|AVX10")


def choose_precision(name: Precision, device: torch.device) -> NumberFormat:
    """Return the number format with this name.

    "auto" is bfloat16 if the device supports it natively and computes faster in it, and if the
    environment allows oneDNN, which computes the convolutions, to use these instructions.
    """
    if name != "auto":
        return name
    import torch

    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:  # without the instructions, bfloat16 is emulated, which is slower than float32
        found = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
        native = bool(found.get("amx_bf16") or found.get("bf16"))
        # Without AMX, an Intel Xeon takes a fifth more time for a capture than in float32.
        native |= bool(found.get("avx512_bf16")) and "Intel" not in found.get("cpu_name", "")
        limits = (os.environ.get(f"{name}_MAX_CPU_ISA", "ALL") for name in ("ONEDNN", "DNNL"))
        native = native and all(map(_HAS_BFLOAT16.match, limits))
    return "bfloat16" if native else "float32"


def use_available_cores() -> None:
    """Limit PyTorch's threads to the cores that this process may use.

    Call this once before a long computation. PyTorch starts one thread per core of the machine,
    even if a container may use fewer cores. Then the threads share the cores, and each step waits
    for the slowest. The number is never increased, so OMP_NUM_THREADS and torch.set_num_threads
    remain effective.
    """
    import torch

    if (cores := count_available_cores()) < torch.get_num_threads():
        torch.set_num_threads(cores)


def count_available_cores() -> int:
    """Return the number of cores that this process may use, at least 1.

    It is the minimum of the machine's cores, the process's CPU affinity, and the CPU quota of its
    control group, which is set by containers and job schedulers (Linux).
    """
    limits = [os.cpu_count() or 1, *cgroup_quotas()]
    if hasattr(os, "sched_getaffinity"):
        limits.append(len(os.sched_getaffinity(0)))
    return max(1, int(min(limits)))


def count_chosen_cores() -> int:
    """Return the number of available cores, or OMP_NUM_THREADS if that is less, which divides the
    cores among workers.
    """
    chosen, cores = os.environ.get("OMP_NUM_THREADS", ""), count_available_cores()
    return max(1, min(cores, int(chosen))) if chosen.isdecimal() else cores


def cgroup_quotas() -> list[float]:
    """Return the CPU quotas, in cores, of this process's control groups and their parents."""
    quotas = []
    for folder in own_groups("cpu"):
        # Quota and period are in microseconds, in one file (version 2) or two (version 1). Without
        # a quota, the first is "max" or -1.
        for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
            with suppress(OSError):
                content = " ".join((folder / name).read_text("utf-8") for name in names)
                quota, period = content.split()
                if quota not in ("max", "-1"):
                    quotas.append(float(quota) / float(period))
    return quotas


_Part = TypeVar("_Part")
_Result = TypeVar("_Result")
_lock, _users, _threads = Lock(), 0, 0


@contextmanager
def one_thread_each() -> Iterator[int]:
    """Limit each operation of PyTorch to one thread, and yield the previous number of threads.

    More threads hardly speed up operations on small arrays. On a busy machine, they make them many
    times slower, because all threads of an operation wait for the slowest.
    """
    import torch

    global _users, _threads
    # Each thread has its own number, and new threads have the number that was set last. Therefore,
    # the first of several callers reads it for all, and each sets it in its own thread.
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


def in_order(
    function: Callable[[_Part], _Result],
    parts: Iterable[_Part],
    threads: int = 1,
    start: Callable[[], object] | None = None,
) -> Iterator[_Result]:
    """Yield function(part) for each part, in order, computed by several threads that call `start`
    first.

    At most one more result than there are threads is kept. Errors are raised when their part is
    due.
    """
    waiting: deque[Future[_Result]] = deque()
    pool = ThreadPoolExecutor(threads, "part", start)
    try:
        for part in parts:
            waiting.append(pool.submit(function, part))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def meanwhile(function: Callable[[], _Result]) -> Iterator[Callable[[], _Result]]:
    """Start function() in another thread, and yield a callable that returns its result or raises
    its error.
    """
    with ThreadPoolExecutor(1, "meanwhile") as pool:
        yield pool.submit(function).result


def side_by_side(function: Callable[[_Part], _Result], parts: Iterable[_Part]) -> Iterator[_Result]:
    """Yield function(part) for each part, as in_order does, without gradients, in PyTorch's
    threads.

    The number of threads is PyTorch's. Within the function, each operation of PyTorch uses one
    thread.
    """
    import torch

    with one_thread_each() as threads:
        # A new thread has OpenMP's number of threads until PyTorch sets its own.
        yield from in_order(
            torch.inference_mode()(function), parts, threads, lambda: torch.set_num_threads(1)
        )
