"""`splinecli infer`: captures in, normal maps out."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splinecli.cli import choices
from splinecli.cli.console import Messages
from splinecli.cli.options import (
    AmbientOption,
    AsStoredOption,
    BatchSizeOption,
    Device,
    DeviceOption,
    FlatFieldOption,
    NormalConvention,
    OverwriteOption,
    Precision,
    PrecisionOption,
    QuietOption,
    RotationsOption,
    SeedOption,
    TransferOption,
    UpdateOption,
    WeightsOption,
    WhiteLevelOption,
    complete_list,
    parse_indices,
    split_commas,
)
from splinecli.errors import SplinecliError, UsageError

if TYPE_CHECKING:
    from splinecli.pipeline.batch import Outcome, Redo
    from splinecli.pipeline.options import InferOptions


_WORDS = {
    "done": "done",
    "skipped": "already done",
    "changed": "changed but kept",
    "missing": "missing",
    "failed": "failed",
}
"""How the last line counts the outcomes."""


def infer(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURE", help="Folders of images, each of one object.")
    ],
    lights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Light directions: a line x y z for each image, z to the camera."),
    ] = None,
    intensities: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|equal",
            help="Light intensities: a line r g b for each image. [default: estimated where they are unequal]",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Mask image: non-zero pixels belong to the object. [default: all pixels]"
        ),
    ] = None,
    auto_mask: Annotated[
        bool,
        typer.Option("--auto-mask", help="Find the object if there is no mask, and write found_mask.png."),
    ] = False,
    ground_truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="True normals to compare with (.mat, .npy, text, PNG, TIFF)."),
    ] = None,
    transfer: TransferOption = "linear",
    ambient: AmbientOption = None,
    flat_field: FlatFieldOption = None,
    white_level: WhiteLevelOption = None,
    as_stored: AsStoredOption = False,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Write results to OUT/<capture name>/.")
    ] = Path("out"),
    method: Annotated[
        str, typer.Option(metavar="METHOD", help="{methods}.", autocompletion=choices.methods)
    ] = "spline-net",
    weights: WeightsOption = None,
    n_lights: Annotated[
        int | None, typer.Option(metavar="K", help="Use K lights drawn at random. [default: all]")
    ] = None,
    seed: SeedOption = 0,
    light_indices: Annotated[
        str | None, typer.Option(metavar="I,J,...", help="Use these lights, counted from 0.")
    ] = None,
    rotations: RotationsOption = None,
    batch_size: BatchSizeOption = None,
    device: DeviceOption = Device.auto,
    precision: PrecisionOption = Precision.auto,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="LIST",
            help="Files of the normal map: any of {formats}. png has 16 bits, png8 has 8, npy and tiff are float32.",
            autocompletion=complete_list(choices.normal_formats),
        ),
    ] = "png,npy",
    maps: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="Further maps to write: any of {maps} (a shaded image).",
            autocompletion=complete_list(choices.maps),
        ),
    ] = None,
    html: Annotated[
        bool, typer.Option("--html", help="Also write page.html: images and a view under a movable light.")
    ] = False,
    surface: Annotated[
        bool,
        typer.Option("--surface", help="Also write mesh.ply, depth.npy and depth.tiff, as integrate does."),
    ] = False,
    convention: Annotated[
        NormalConvention,
        typer.Option(help="Green channel of the PNG files: opengl is y up, directx is y down."),
    ] = NormalConvention.opengl,
    overwrite: OverwriteOption = False,
    update: UpdateOption = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a JSON list of the reports on stdout, and nothing else.")
    ] = False,
    quiet: QuietOption = False,
) -> int:
    """Estimate the normal map of each CAPTURE.

    A CAPTURE is a folder of images of one object, taken by a fixed camera under different lights, with a light file in
    it or given by --lights. Writes OUT/<name>/normals.png, normals.npy and report.json, and error_map.png where there
    is ground truth. With several captures, OUT/index.html links the results.

    Captures that are already done are skipped. A capture whose files or options have changed since is named and keeps
    its results, unless --update or --overwrite is given. A capture that fails does not stop the others. The exit code
    is that of the worst capture.
    """
    from splinecli.pipeline.options import InferOptions

    with _json_documents(as_json) as documents:
        if overwrite and update:
            raise UsageError("--overwrite and --update exclude each other")
        options = InferOptions(
            lights=_text(lights),
            intensities=_text(intensities),
            mask=_text(mask),
            auto_mask=auto_mask,
            ground_truth=_text(ground_truth),
            transfer=transfer,
            ambient=_text(ambient),
            flat_field=_text(flat_field),
            white_level=white_level,
            as_stored=as_stored,
            n_lights=n_lights,
            seed=seed if n_lights is not None else 0,
            light_indices=None if light_indices is None else _indices(light_indices),
            method=method,
            weights=weights,
            rotations=rotations,
            batch_size=batch_size,
            device=device.value,
            precision=precision.value,
            output=str(output),
            formats=tuple(split_commas(formats, "--format", choices.normal_formats())),
            maps=() if maps is None else tuple(split_commas(maps, "--maps", choices.maps())),
            html=html,
            surface=surface,
            convention=convention.value,
        )
        redo: Redo = "all" if overwrite else "changed" if update else "nothing"
        return _run(
            captures, options, Messages(quiet=quiet), redo, documents, summaries=not (quiet or as_json)
        )


@contextmanager
def _json_documents(wanted: bool) -> Iterator[list[dict[str, Any]]]:
    """Yield a list of documents and print it at the end, also after an error, if it is wanted."""
    from splinecli.pipeline.batch import error_document

    documents: list[dict[str, Any]] = []
    try:
        yield documents
    except SplinecliError as error:
        documents.append(error_document(error))
        raise
    finally:
        if wanted:
            print(json.dumps(documents, indent=2))


def _run(
    captures: Sequence[Path],
    options: InferOptions,
    messages: Messages,
    redo: Redo,
    documents: list[dict[str, Any]],
    *,
    summaries: bool,
) -> int:
    """Run the batch, print what becomes of each capture, and return the exit code."""
    from splinecli.pipeline.batch import infer_batch, worst_exit_code

    outcomes, output = [], Path(options.output)
    for outcome in infer_batch(captures, options, messages, redo=redo):
        outcomes.append(outcome)
        documents.append(outcome.report)
        _show(outcome, output, messages, with_summary=summaries)
    if any(outcome.status == "missing" for outcome in outcomes):
        if len(captures) > 1:
            messages.say("Nothing was computed.")
    elif len(captures) > 1:
        _show_table(outcomes, output, messages)
    return worst_exit_code(outcome.exit_code for outcome in outcomes)


def _indices(text: str) -> tuple[int, ...]:
    return tuple(parse_indices(text, "--light-indices"))


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _show(outcome: Outcome, output: Path, messages: Messages, *, with_summary: bool) -> None:
    """Print what became of a capture. Failures are printed even with --quiet."""
    if outcome.status == "done":
        if with_summary:
            print(_summary(outcome.report, output))
    elif outcome.status == "skipped":
        messages.say(f"{output / outcome.capture}: already done, skipped")
    else:
        print(f"{outcome.trace}splinecli: {outcome.report['error']}", file=sys.stderr)


def _show_table(outcomes: Sequence[Outcome], output: Path, messages: Messages) -> None:
    from splinecli.results.index import HEADER, INDEX, row_of

    good = [row_of(outcome.report) for outcome in outcomes if outcome.status in ("done", "skipped")]
    if good:
        columns = [column for column in zip(HEADER, *good, strict=True) if any(column[1:])]
        messages.table(list(zip(*columns, strict=True)))
    counts = Counter(_WORDS[outcome.status] for outcome in outcomes)
    text = ", ".join(f"{counts[word]} {word}" for word in _WORDS.values() if counts[word])
    messages.say(f"{len(outcomes)} captures: {text}; see {output / INDEX}")


def _summary(report: dict[str, Any], output: Path) -> str:
    errors, expected = report["angular_error_deg"], report["expected_under_5"]
    scored = ""
    if errors is not None:
        scored = f", MAE {errors['mean']:.2f} deg (median {errors['median']:.2f})"
    elif expected is not None:
        scored = f", {expected:.0%} of them likely within 5 deg"
    counts = f"{report['n_pixels']} pixels, {report['n_lights']} lights"
    return f"{output / report['capture']}: {counts}, {report['method']}{scored}"
