"""Devices and precision."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from splinecli.devices import choose_device, choose_precision
from splinecli.errors import UsageError


def test_unknown_device() -> None:
    with pytest.raises(UsageError, match="no device named 'gpu'; expected auto, cpu or cuda"):
        choose_device("gpu")


@pytest.mark.parametrize(
    ("name", "available", "chosen"),
    [("auto", True, "cuda"), ("auto", False, "cpu"), ("cpu", True, "cpu"), ("cuda", True, "cuda")],
)
def test_choice(monkeypatch: pytest.MonkeyPatch, name: str, available: bool, chosen: str) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    assert choose_device(name).type == chosen


def test_cuda_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match="no CUDA device was found"):
        choose_device("cuda")


def test_a_named_precision_is_taken_as_it_is() -> None:
    assert choose_precision("bfloat16", torch.device("cpu")) == "bfloat16"
    assert choose_precision("float32", torch.device("cpu")) == "float32"


def test_automatic_precision_agrees_with_the_kernel_s_list_of_instructions() -> None:
    listing = Path("/proc/cpuinfo")
    flags = set(listing.read_text().split()) if listing.exists() else set()
    if "flags" not in flags or not hasattr(torch.cpu, "get_capabilities"):
        pytest.skip("only x86 Linux lists its instructions so, and only torch from 2.10 knows them")
    native = bool({"avx512_bf16", "amx_bf16"} & flags)
    assert choose_precision("auto", torch.device("cpu")) == ("bfloat16" if native else "float32")
