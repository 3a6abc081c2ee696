"""Which device to compute on, and in which precision."""

from __future__ import annotations

from typing import Literal

import torch

from splinecli.errors import UsageError


def choose_device(name: Literal["auto", "cpu", "cuda"] | str) -> torch.device:
    """The device of this name; "auto" takes a CUDA GPU where there is one. Raises UsageError."""
    if name not in ("auto", "cpu", "cuda"):
        raise UsageError(f"no device named {name!r}; expected auto, cpu or cuda")
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UsageError("no CUDA device was found", hint="Use --device cpu or auto")
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def choose_precision(
    name: Literal["auto", "float32", "bfloat16"], device: torch.device
) -> Literal["float32", "bfloat16"]:
    """ "auto" takes bfloat16 where the device computes in it natively, float32 elsewhere."""
    if name != "auto":
        return name
    if device.type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    # Without the instructions a CPU emulates bfloat16, slower than float32.
    return "bfloat16" if _cpu_has_bfloat16() else "float32"


def _cpu_has_bfloat16() -> bool:
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16") or capabilities.get("bf16"))
