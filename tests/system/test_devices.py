"""Devices, precision, threads, memory and optional packages."""

import sys
from pathlib import Path

import pytest
import torch

from scenes import parametrize, put, refuses
from splinecli.errors import UsageError
from splinecli.system import machine
from splinecli.system.machine import (
    available_memory,
    cgroup_quotas,
    choose_device,
    choose_precision,
    import_extra,
)


@parametrize(
    "name, available, chosen",
    [("auto", True, "cuda"), ("auto", False, "cpu"), ("cpu", True, "cpu"), ("cuda", True, "cuda")],
)
def test_choice(monkeypatch, name, available, chosen):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    assert choose_device(name).type == chosen


@parametrize(
    "name, problem",
    """
gpu | no device named 'gpu'; expected auto, cpu or cuda
cuda | no CUDA device
""",
)
def test_devices_that_are_not_there(monkeypatch, name, problem):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with refuses(problem, UsageError):
        choose_device(name)


def test_automatic_precision_agrees_with_the_kernel_s_list_of_instructions():
    listing = Path("/proc/cpuinfo")
    flags = set(listing.read_text().split()) if listing.exists() else set()
    if "flags" not in flags or not hasattr(torch.cpu, "get_capabilities"):
        pytest.skip("only x86 Linux lists its instructions so, and only torch from 2.10 knows them")
    native = "amx_bf16" in flags or ("avx512_bf16" in flags and "GenuineIntel" not in flags)
    assert choose_precision("auto", torch.device("cpu")) == ("bfloat16" if native else "float32")


@parametrize(
    ("limit", "has_bfloat16"),
    [("AVX2", False), ("AVX512_CORE", False), ("avx512_core_bf16", True), ("DEFAULT", True)],
)
def test_automatic_precision_respects_the_limit_of_onednn(limit, has_bfloat16, monkeypatch):
    """Emulated, bfloat16 takes more than twice as long as float32."""
    found = {"amx_bf16": True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: found, raising=False)
    monkeypatch.setenv("DNNL_MAX_CPU_ISA", limit)
    expected = "bfloat16" if has_bfloat16 else "float32"
    assert choose_precision("auto", torch.device("cpu")) == expected


@parametrize(
    "found, expected",
    [
        ({"avx512_bf16": True, "cpu_name": "AMD EPYC 9654"}, "bfloat16"),
        ({"avx512_bf16": True, "cpu_name": "Intel Xeon"}, "float32"),
        ({"avx512_bf16": True, "amx_bf16": True, "cpu_name": "Intel Xeon"}, "bfloat16"),
        ({"bf16": True}, "bfloat16"),
        ({}, "float32"),
    ],
)
def test_automatic_precision_is_the_faster_one(found, expected, monkeypatch):
    """Intel processors without AMX are slower in bfloat16."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: found, raising=False)
    for name in ("ONEDNN", "DNNL"):
        monkeypatch.delenv(f"{name}_MAX_CPU_ISA", raising=False)
    assert choose_precision("auto", torch.device("cpu")) == expected


@pytest.fixture
def mount(tmp_path, monkeypatch):
    """The folder of control groups, beside the file `groups` that says in which ones this process
    is.
    """
    monkeypatch.setattr(machine, "GROUPS", tmp_path / "groups")
    monkeypatch.setattr(machine, "MOUNT", tmp_path / "mount")
    return tmp_path / "mount"


def enter(mount, groups):
    put(mount.parent / "groups", groups)


V1 = "cpu,cpuacct"
QUOTAS = {
    "version 2": (
        "0::/jobs/ours\n",
        {"cpu.max": "max 1", "jobs/cpu.max": "3 1", "jobs/ours/cpu.max": "4 1"},
        [3, 4],
    ),
    "the top": ("0::/\n", {"cpu.max": "max 100000\n", "jobs/cpu.max": "300000 100000\n"}, []),
    "a container that shows the host's path": (
        "0::/docker/0123abcd\n",
        {"cpu.max": "150000 100000\n"},
        [1.5],
    ),
    "version 1": (
        "12:memory:/box\n4:cpu,cpuacct:/box\n1:name=systemd:/box\n",
        {f"{V1}/cpu.cfs_quota_us": "-1\n", f"{V1}/cpu.cfs_period_us": "100000\n"}
        | {f"{V1}/box/cpu.cfs_quota_us": "50000\n", f"{V1}/box/cpu.cfs_period_us": "100000\n"},
        [0.5],
    ),
}


@parametrize("case", QUOTAS)
def test_quotas_of_control_groups(mount, case):
    """The groups above limit a process, too."""
    groups, files, expected = QUOTAS[case]
    for name, text in files.items():
        put(mount / name, text)
    assert cgroup_quotas() == []
    enter(mount, groups)
    assert sorted(cgroup_quotas()) == expected


def test_memory_left_in_control_groups(mount, monkeypatch):
    """A job of Slurm or systemd is in a group within groups. Each of them may have a limit."""
    monkeypatch.setattr(machine, "free_memory", lambda: 9e9)
    monkeypatch.setattr(machine, "left_in_address_space", lambda: 8e9)
    assert available_memory() == 8e9
    enter(mount, "0::/jobs/ours\n")
    put(mount / "jobs/ours/memory.max", "max\n")
    put(mount / "jobs/ours/memory.current", "100\n")
    assert available_memory() == 8e9
    put(mount / "jobs/memory.max", "5000\n")
    put(mount / "jobs/memory.current", "3000\n")
    put(mount / "jobs/memory.stat", "anon 2500\ninactive_file 500\n")
    assert available_memory() == 5000 - 3000 + 500


def test_memory_left_in_control_groups_of_version_1(mount, monkeypatch):
    monkeypatch.setattr(machine, "free_memory", lambda: 8e9)
    monkeypatch.setattr(machine, "left_in_address_space", lambda: 9e9)
    enter(mount, "12:cpu:/cpu\n4:memory:/box/ours\n0::/\n")
    for group, limit in (
        ("", 9223372036854771712),
        ("box", 5000),
        ("box/ours", 9223372036854771712),
    ):
        put(mount / "memory" / group / "memory.limit_in_bytes", f"{limit}\n")
        put(mount / "memory" / group / "memory.usage_in_bytes", "3000\n")
    put(mount / "memory/box/memory.stat", "inactive_file 7\ntotal_inactive_file 500\n")
    assert available_memory() == 5000 - 3000 + 500
    enter(mount, "12:cpu:/cpu\n4:memory:/\n0::/\n")
    assert available_memory() == 8e9


@parametrize(
    "cores, affinity, quotas, expected",
    [(8, 8, [], 8), (8, 3, [], 3), (8, 8, [2.5, 4], 2), (8, 8, [0.5], 1), (None, 1, [], 1)],
)
def test_available_cores(cores, affinity, quotas, expected, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(affinity)), raising=False)
    monkeypatch.setattr(machine, "cgroup_quotas", lambda: quotas)
    assert machine.count_available_cores() == expected


@parametrize("threads, cores, expected", [(8, 2, 2), (1, 4, 1), (2, 2, 2)])
def test_threads_are_only_ever_lowered(threads, cores, expected, monkeypatch):
    now = [threads]
    monkeypatch.setattr(torch, "get_num_threads", lambda: now[0])
    monkeypatch.setattr(torch, "set_num_threads", lambda count: now.__setitem__(0, count))
    monkeypatch.setattr(machine, "count_available_cores", lambda: cores)
    machine.use_available_cores()
    assert now[0] == expected


@parametrize(
    "module, extra, named",
    """
embreex.rtcore_scene | render | embreex and scikit-image
fast_simplification | mesh | fast-simplification
""",
)
def test_the_message_names_the_packages_and_the_command(module, extra, named, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with refuses(rf"{named}.*Run pip install 'splinecli\[{extra}\]'", UsageError):
        import_extra(module, extra)
