"""Choice of the device, the number format, and the number of threads."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import TYPE_CHECKING, Literal

from splinecli.errors import UsageError
from splinecli.system.memory import own_groups

if TYPE_CHECKING:
    import torch


Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]


def choose_device(name: Device | str) -> torch.device:
    """Return the device of this name; "auto" is a CUDA GPU if there is one, else the CPU. Raises UsageError."""
    if name not in ("auto", "cpu", "cuda"):
        raise UsageError(f"no device named {name!r}; expected auto, cpu or cuda")
    import torch

    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UsageError("no CUDA device was found", hint="Use --device cpu or auto")
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def choose_precision(name: Precision, device: torch.device) -> Literal["float32", "bfloat16"]:
    """Return the number format of this name; "auto" is bfloat16 where the device computes natively in it."""
    if name != "auto":
        return name
    import torch

    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:  # a CPU without the instructions emulates bfloat16, which is slower than float32
        found = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
        native = bool(found.get("avx512_bf16") or found.get("amx_bf16") or found.get("bf16"))
    return "bfloat16" if native else "float32"


def use_available_cores() -> None:
    """Limit PyTorch's threads to the cores that this process may use.

    Call it once before a long computation. PyTorch starts one thread per core of the machine, even where a container
    may use only some of them. The threads then take turns, and each step waits for the last one. The number is only
    ever lowered, so OMP_NUM_THREADS and torch.set_num_threads keep their effect.
    """
    import torch

    if (cores := count_available_cores()) < torch.get_num_threads():
        torch.set_num_threads(cores)


def count_available_cores() -> int:
    """Return the number of cores that this process may use, at least 1.

    It is the smallest of the machine's cores, the process's CPU affinity, and the CPU quota of its control group, which
    containers and job schedulers set (Linux).
    """
    limits = [os.cpu_count() or 1, *cgroup_quotas()]
    if hasattr(os, "sched_getaffinity"):
        limits.append(len(os.sched_getaffinity(0)))
    return max(1, int(min(limits)))


def cgroup_quotas() -> list[float]:
    """Return the CPU quotas, in cores, of this process's control groups and of the groups above them."""
    quotas = []
    for folder in own_groups("cpu"):
        # Quota and period in microseconds: in one file of version 2, or in two of version 1. The first is "max" or -1
        # where there is none.
        for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
            with suppress(OSError):
                quota, period = " ".join((folder / name).read_text("utf-8") for name in names).split()
                quotas += [] if quota in ("max", "-1") else [float(quota) / float(period)]
    return quotas
