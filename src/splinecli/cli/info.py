"""`splinecli info`: what would be read of a capture, and what to expect."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import (
    AmbientOption,
    FlatFieldOption,
    JsonOption,
    QuietOption,
    TransferOption,
    parse_radiometry,
)
from splinecli.errors import UsageError

if TYPE_CHECKING:
    from splinecli.capture.summary import CaptureSummary

PIXELS_PER_SECOND = 2000
"""Of spline-net on a laptop's processor; benchmarks/inference_speed.py measures a machine's own."""

BASE_MIB = 700
"""What Python, PyTorch and a batch of pixels need, beside what grows with the capture."""


def info(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder of images of one object.")],
    lights: Annotated[Path | None, typer.Option(metavar="FILE", help="Light directions.")] = None,
    intensities: Annotated[Path | None, typer.Option(metavar="FILE", help="Light intensities.")] = None,
    mask: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture that is bright on the object.")
    ] = None,
    ground_truth: Annotated[Path | None, typer.Option(metavar="FILE", help="True normals.")] = None,
    transfer: TransferOption = "linear",
    ambient: AmbientOption = None,
    flat_field: FlatFieldOption = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also draw where the lights stand, as a PNG.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier plot.")] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Say what would be read of a CAPTURE.

    The layout and files recognised, size and bit depth of the images, how they are exposed, where the lights stand,
    and what memory and time to expect of infer. No normals are estimated, and nothing is written but the plot.
    """
    from splinecli.capture import open_capture
    from splinecli.capture.summary import summarise_capture
    from splinecli.files import check_free, write_bytes

    source = open_capture(
        capture,
        lights=lights,
        intensities=intensities,
        mask=mask,
        ground_truth=ground_truth,
        radiometry=parse_radiometry(transfer, ambient, flat_field),
    )
    if plot is not None:
        if plot.absolute().parent in {path.absolute().parent for path in source.files.images}:
            raise UsageError(f"{plot} would lie among the photographs, and count as one the next time")
        check_free(plot.parent, [plot.name], overwrite=overwrite)
    talk = Messages(quiet=quiet)
    with talk.progress("reading", len(source.files.images)) as advance:
        summary = summarise_capture(source, progress=lambda: advance(1))
    if plot is not None:
        from splinecli.pictures.light_sky import sky_plot

        write_bytes(plot, sky_plot(source.light_directions, source.files.name))
    report = _report(summary)
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        print("\n".join(_lines(report)))
    for warning in report["warnings"]:
        talk.warn(warning)


def _report(summary: CaptureSummary) -> dict[str, Any]:
    source, files = summary.source, summary.source.files
    kinds = sorted(
        {(image.shape[1], image.shape[0], image.shape[2], image.dtype) for image in summary.images}
    )
    elevations, bright = summary.elevations_deg, [image.bright for image in summary.images]
    strengths = files.light_intensities
    if strengths is None and (source.light_intensities != 1).any():
        strengths = files.light_directions  # AliceVision's hold both
    # Observations in float32, the estimate in float32, and one image as it is decoded.
    first = summary.images[0]
    mib = (
        BASE_MIB
        + (summary.n_pixels * (4 * source.n_lights + 40) + 8 * first.shape[0] * first.shape[1] * 3) / 2**20
    )
    return {
        "capture": files.name,
        "layout": files.layout,
        "images": len(summary.images),
        "image_kinds": [
            {"size": [width, height], "channels": channels, "type": dtype}
            for width, height, channels, dtype in kinds
        ],
        "n_pixels": summary.n_pixels,
        "light_directions": str(files.light_directions),
        "light_intensities": str(strengths) if strengths is not None else None,
        "mask": None if files.mask is None else str(files.mask),
        "ground_truth": None if files.ground_truth is None else str(files.ground_truth),
        "elevation_deg": [round(float(elevations.min()), 1), round(float(elevations.max()), 1)],
        "exposure": {
            "bright": [round(min(bright), 4), round(max(bright), 4)],
            "saturated": round(max(image.saturated for image in summary.images), 4),
        },
        "expect": {"memory_mib": round(mib), "seconds": round(3 + summary.n_pixels / PIXELS_PER_SECOND)},
        "warnings": [str(warning) for warning in summary.warnings()],
    }


def _lines(report: dict[str, Any]) -> list[str]:
    names = {"uint8": "8 bits", "uint16": "16 bits"}
    kinds = ", ".join(
        f"{kind['size'][0]} x {kind['size'][1]}, {'gray' if kind['channels'] == 1 else 'RGB'},"
        f" {names.get(kind['type'], kind['type'])}"
        for kind in report["image_kinds"]
    )
    low, high = report["elevation_deg"]
    dark, bright = report["exposure"]["bright"]
    rows = [
        ("capture", f"{report['capture']} ({report['layout']})"),
        ("images", f"{report['images']}: {kinds}"),
        ("lights", f"{report['light_directions']}, {low:.0f} to {high:.0f} degrees above the picture's plane"),
        ("intensities", report["light_intensities"] or "none: equal, unless the images plainly say otherwise"),
        ("mask", f"{report['mask'] or 'none: every pixel counts'} ({report['n_pixels']} pixels)"),
        ("ground truth", report["ground_truth"] or "none"),
        ("exposure", f"brightest 1 % from {100 * dark:.0f} to {100 * bright:.0f} % of full scale, at most"
                     f" {100 * report['exposure']['saturated']:.1f} % of an image saturated"),
        ("expect", f"{report['expect']['memory_mib']} MiB, about {report['expect']['seconds']} s on a laptop"),
    ]  # fmt: skip
    return [f"{name:13}{text}" for name, text in rows]
