"""Option types that several commands share, the parsing of their values, and what a shell may complete them to."""

from __future__ import annotations

import json
from collections.abc import Callable
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from splinecli.errors import UsageError

if TYPE_CHECKING:
    from splinecli.capture import RadiometricCalibration


class Device(StrEnum):
    """Where to compute."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class NormalConvention(StrEnum):
    """Which way green points in the picture."""

    opengl = "opengl"
    directx = "directx"


class Precision(StrEnum):
    """What to compute in."""

    auto = "auto"
    float32 = "float32"
    bfloat16 = "bfloat16"


def complete_methods() -> list[str]:
    """What --method may be."""
    from splinecli.methods import method_names

    return method_names()


def complete_weights() -> list[str]:
    """Names of the shipped weights. Where none begins like what was typed, the shell completes to files."""
    # What else reads this file imports torch, which takes longer than one waits for a completion.
    return list(json.loads((resources.files("splinecli") / "assets/weights.json").read_text("utf-8")))


def complete_list(*items: str) -> Callable[[str], list[str]]:
    """Completion of "a,b": to what was typed up to the last comma, and each item that is not in it."""

    def complete(incomplete: str) -> list[str]:
        *typed, _ = incomplete.split(",")
        return [",".join([*typed, item]) for item in items if item not in typed]

    return complete


TransferOption = Annotated[
    str,
    typer.Option(
        "--transfer",
        metavar="CURVE",
        help="Of the images: linear, srgb or gamma:G.",
        autocompletion=lambda: ["linear", "srgb", "gamma:2.2"],
    ),
]
AmbientOption = Annotated[
    Path | None,
    typer.Option(
        "--ambient",
        metavar="FILE",
        help="Image without any of the lights, to be taken off. [default: ambient.*]",
    ),
]
FlatFieldOption = Annotated[
    Path | None,
    typer.Option(
        "--flat-field", metavar="DIR", help="Images of something evenly white, one for each light or for all."
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
        help="Use the stored values alone: restore no saturated pixels, estimate no intensities.",
    ),
]
WeightsOption = Annotated[
    str | None,
    typer.Option(
        "--weights",
        metavar="NAME|FILE",
        help="Shipped weights by name, or a file. [default: the method's]",
        autocompletion=complete_weights,
    ),
]
RotationsOption = Annotated[
    int | None,
    typer.Option(
        "--rotations",
        metavar="R",
        min=1,
        help="Views of each pixel that a network averages. [default: 1; cnn-ps: 10]",
    ),
]
DeviceOption = Annotated[
    Device, typer.Option("--device", help="Where to compute; auto takes a CUDA GPU if any.")
]
PrecisionOption = Annotated[
    Precision, typer.Option("--precision", help="auto takes bfloat16 where the hardware computes in it.")
]
BatchSizeOption = Annotated[
    int | None, typer.Option("--batch-size", metavar="N", min=1, help="Pixels at a time in the network.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
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
    """The items of "a,b". Raises UsageError for one that is not allowed."""
    items = [item.strip() for item in text.split(",") if item.strip()]
    for item in items:
        if item not in allowed:
            raise UsageError(
                f"{option} holds {item!r}; expected a list of {', '.join(allowed)}, such as {allowed[0]}"
            )
    if not items:
        raise UsageError(f"{option} is empty; expected a list of {', '.join(allowed)}")
    return items


def parse_indices(text: str, option: str) -> list[int]:
    """Whole numbers from "0,5,12". Raises UsageError."""
    try:
        return [int(item) for item in text.split(",")]
    except ValueError:
        raise UsageError(f"{option} is {text!r}; expected zero-based numbers such as 0,5,12") from None


def parse_radiometry(transfer: str, ambient: Path | None, flat_field: Path | None) -> RadiometricCalibration:
    """Return what --transfer, --ambient and --flat-field ask for. Raises UsageError, InputError."""
    from splinecli.pipeline.options import radiometric_calibration

    return radiometric_calibration(transfer, ambient, flat_field)
