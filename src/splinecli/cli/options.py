"""Options that several commands share, their completion, and the parsing of their values."""

from __future__ import annotations

import json
from collections.abc import Callable
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from splinecli.cli import choices
from splinecli.errors import UsageError


class Device(StrEnum):
    """Device to compute on."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class NormalConvention(StrEnum):
    """Direction of the green channel of a normal map: up in opengl, down in directx."""

    opengl = "opengl"
    directx = "directx"


class Precision(StrEnum):
    """Number format to compute in."""

    auto = "auto"
    float32 = "float32"
    bfloat16 = "bfloat16"


complete_methods = choices.methods


def complete_weights() -> list[str]:
    """Return the names of the shipped weights. If none begins with the typed text, the shell completes file names."""
    # The module that reads this file imports torch, which takes too long for a completion.
    return list(json.loads((resources.files("splinecli") / "assets/weights.json").read_text("utf-8")))


def complete_list(*items: str | Callable[[], list[str]]) -> Callable[[str], list[str]]:
    """Return the completion of a list "a,b": the typed items, and each further one behind the last comma.

    Args:
        items: the items, or functions that return them.
    """

    def complete(incomplete: str) -> list[str]:
        *typed, _ = incomplete.split(",")
        names = [name for item in items for name in ([item] if isinstance(item, str) else item())]
        return [",".join([*typed, name]) for name in names if name not in typed]

    return complete


TransferOption = Annotated[
    str,
    typer.Option(
        "--transfer",
        metavar="CURVE",
        help="Transfer curve of the images: linear, srgb or gamma:G.",
        autocompletion=lambda: ["linear", "srgb", "gamma:2.2"],
    ),
]
AmbientOption = Annotated[
    Path | None,
    typer.Option(
        "--ambient",
        metavar="FILE",
        help="Image taken without the lights, to subtract from all images. [default: ambient.*]",
    ),
]
FlatFieldOption = Annotated[
    Path | None,
    typer.Option(
        "--flat-field",
        metavar="DIR",
        help="Images of an evenly white surface: one for all lights, or one each.",
    ),
]
WhiteLevelOption = Annotated[
    float | None,
    typer.Option(
        "--white-level",
        metavar="N",
        min=0,
        help="Stored value from which a pixel counts as saturated. [default: found in the images]",
    ),
]
AsStoredOption = Annotated[
    bool,
    typer.Option(
        "--as-stored",
        help="Neither restore saturated pixels nor estimate unknown light intensities.",
    ),
]
WeightsOption = Annotated[
    str | None,
    typer.Option(
        "--weights",
        metavar="NAME|FILE",
        help="Weights: a shipped name or a file. [default: those of the method]",
        autocompletion=complete_weights,
    ),
]
RotationsOption = Annotated[
    int | None,
    typer.Option(
        "--rotations",
        metavar="R",
        min=1,
        help="Rotated copies of each pixel that a network averages over. [default: 1; cnn-ps: 10]",
    ),
]
DeviceOption = Annotated[
    Device, typer.Option("--device", help="Device to compute on. auto takes a CUDA GPU if there is one.")
]
PrecisionOption = Annotated[
    Precision,
    typer.Option("--precision", help="Number format. auto takes bfloat16 where the hardware supports it."),
]
BatchSizeOption = Annotated[
    int | None,
    typer.Option("--batch-size", metavar="N", min=1, help="Pixels that the method computes at a time."),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace earlier results.")]
UpdateOption = Annotated[
    bool, typer.Option("--update", help="Redo captures that changed, skip those that are done.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else.")
]
SeedOption = Annotated[
    int, typer.Option("--seed", metavar="S", min=0, max=2**32 - 1, help="Seed of the random draws.")
]


def split_commas(text: str, option: str, allowed: list[str]) -> list[str]:
    """Return the items of "a,b". Raises UsageError for an item that is not allowed."""
    items = [item.strip() for item in text.split(",") if item.strip()]
    for item in items:
        if item not in allowed:
            raise UsageError(
                f"{option} has {item!r}; expected a list of {', '.join(allowed)}, such as {allowed[0]}"
            )
    if not items:
        raise UsageError(f"{option} is empty; expected a list of {', '.join(allowed)}")
    return items


def parse_indices(text: str, option: str) -> list[int]:
    """Return the whole numbers of "0,5,12". Raises UsageError."""
    try:
        return [int(item) for item in text.split(",")]
    except ValueError:
        raise UsageError(f"{option} is {text!r}; expected zero-based numbers such as 0,5,12") from None
