"""`splinecli info`: what `infer` would read from a capture, and what to expect."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import (
    AmbientOption,
    FlatFieldOption,
    JsonOption,
    QuietOption,
    TransferOption,
    WhiteLevelOption,
)
from splinecli.pipeline.info import InfoOptions, describe_capture, summary_lines


def info(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder of images of one object.")],
    lights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Light directions, a line x y z for each image (z to the camera)."),
    ] = None,
    intensities: Annotated[
        Path | None,
        typer.Option(metavar="FILE|equal", help="Light intensities, a line r g b for each image."),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Mask image: non-zero pixels belong to the object. [default: all]"),
    ] = None,
    ground_truth: Annotated[
        Path | None, typer.Option(metavar="FILE", help="True normals (.mat, .npy, text, PNG, TIFF).")
    ] = None,
    transfer: TransferOption = "linear",
    ambient: AmbientOption = None,
    flat_field: FlatFieldOption = None,
    white_level: WhiteLevelOption = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also plot the light directions to a PNG file.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier plot.")] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Show what `infer` would read from CAPTURE, without running it.

    Prints the layout and files of the capture, the size and bit depth of the images, their white level and exposure,
    the elevation of the lights, and the memory and time that infer needs. Writes nothing but the plot.
    """
    options = InfoOptions(
        capture=capture,
        lights=lights,
        intensities=intensities,
        mask=mask,
        ground_truth=ground_truth,
        transfer=transfer,
        ambient=ambient,
        flat_field=flat_field,
        white_level=white_level,
        plot=plot,
        overwrite=overwrite,
    )
    report = describe_capture(options, Messages(quiet=quiet))
    if as_json:
        print(json.dumps(report, indent=2))
    elif not quiet:
        print("\n".join(summary_lines(report)))
