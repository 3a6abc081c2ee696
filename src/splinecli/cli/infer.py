"""`splinecli infer`: captures in, normal maps out."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from splinecli.cli.options import (
    AmbientOption,
    BatchSizeOption,
    Device,
    DeviceOption,
    FlatFieldOption,
    JsonOption,
    NormalConvention,
    OverwriteOption,
    Precision,
    PrecisionOption,
    QuietOption,
    RotationsOption,
    SeedOption,
    TransferOption,
    WeightsOption,
    complete_list,
    complete_methods,
    parse_indices,
    parse_radiometry,
    split_commas,
)
from splinecli.cli.talk import Talk
from splinecli.errors import InputError, OutputError, UsageError
from splinecli.pipeline.infer import Job, inputs_sha256


def infer(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURE", help="Folders of images of one object each.")
    ],
    lights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Light directions, a line x y z for each image (z to the camera)."),
    ] = None,
    intensities: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|equal",
            help="Light intensities, a line r g b for each image. [default: equal, unless they plainly are not]",
        ),
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture that is bright on the object. [default: all]")
    ] = None,
    auto_mask: Annotated[
        bool,
        typer.Option(
            "--auto-mask", help="Find the object where there is no mask; found_mask.png is what was found."
        ),
    ] = False,
    ground_truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="True normals (.mat, .npy, text, PNG, TIFF) to compare with."),
    ] = None,
    transfer: TransferOption = "linear",
    ambient: AmbientOption = None,
    flat_field: FlatFieldOption = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Results go to OUT/<capture name>/.")
    ] = Path("out"),
    method: Annotated[
        str,
        typer.Option(
            metavar="METHOD",
            help="spline-net, cnn-ps, ls, ls-trimmed, l1, iw12, st14 or ia14.",
            autocompletion=complete_methods,
        ),
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
            help="Any of png (16-bit), png8 (8-bit), npy, tiff (both float32).",
            autocompletion=complete_list("png", "png8", "npy", "tiff"),
        ),
    ] = "png,npy",
    maps: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="Also write any of albedo, confidence, preview (shaded picture).",
            autocompletion=complete_list("albedo", "confidence", "preview"),
        ),
    ] = None,
    html: Annotated[
        bool, typer.Option("--html", help="Also write page.html: pictures and a view under a movable light.")
    ] = False,
    surface: Annotated[
        bool, typer.Option("--surface", help="Also write mesh.ply, depth.npy and depth.tiff: see integrate.")
    ] = False,
    convention: Annotated[
        NormalConvention, typer.Option(help="Green of the PNG: opengl is y up, directx is y down.")
    ] = NormalConvention.opengl,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Estimate the normal map of each CAPTURE.

    A capture is a folder of images taken by a fixed camera under different lights, with a light file (in it, or given
    by --lights). Writes OUT/<name>/normals.png, normals.npy and report.json, and error_map.png where there is ground
    truth. A bad capture among several is named and passed over; the exit code is then 3. Those that were finished
    before with the same options are left as they are. OUT/index.html links the results of several.
    """
    from splinecli.capture import capture_name
    from splinecli.capture.lights.draws import check_draw_settings
    from splinecli.capture.record import check_light_indices
    from splinecli.files import check_free, write_text
    from splinecli.methods import MethodOptions, check_method
    from splinecli.results.files import MAPS, NORMALS, OWN_FILES, REPORT, finished_report
    from splinecli.results.index import INDEX, check_index_free, has_index, index_page, with_earlier

    if n_lights is not None and light_indices is not None:
        raise UsageError("--n-lights and --light-indices exclude each other")
    if mask is not None and auto_mask:
        raise UsageError("--mask and --auto-mask exclude each other")
    check_method(method)
    indices = None if light_indices is None else parse_indices(light_indices, "--light-indices")
    if n_lights is not None:
        check_draw_settings(n_lights, 1, seed)
    if indices is not None:
        check_light_indices(indices, max(indices) + 1)
    radiometry = parse_radiometry(transfer, ambient, flat_field)
    _refuse_same_names(captures)
    options = {
        "method": method, "weights": weights, "rotations": rotations, "precision": precision.value,
        "n_lights": n_lights, "seed": seed if n_lights is not None else None, "light_indices": indices,
        "lights": lights, "intensities": intensities, "mask": mask, "ground_truth": ground_truth,
        "auto_mask": auto_mask, "transfer": transfer, "ambient": ambient, "flat_field": flat_field,
        "formats": formats, "convention": convention.value, "maps": maps, "surface": surface, "html": html,
    }  # fmt: skip
    options = {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}
    files = {"lights": lights, "intensities": intensities, "mask": mask, "ground_truth": ground_truth}

    def inputs_of(folder: Path) -> str:
        from splinecli.capture import open_capture

        try:
            return inputs_sha256(open_capture(folder, radiometry=radiometry, **files), weights)
        except InputError:
            return ""  # told when its turn comes

    if len(captures) > 1:
        check_index_free(output, overwrite=overwrite)
    finished = {}
    for folder in captures:
        target = output / capture_name(folder)
        report = (
            None
            if overwrite or len(captures) == 1
            else finished_report(target, options, partial(inputs_of, folder))
        )
        if report is None:
            if len(captures) > 1 and not overwrite and (target / REPORT).is_file():
                raise OutputError(
                    "holds results already, but of other options, other inputs or another version",
                    path=target,
                    hint="Add --overwrite to make all anew, or choose another place with -o",
                )
            check_free(target, OWN_FILES, overwrite=overwrite)
        else:
            finished[folder] = report
    job = Job(
        radiometry=radiometry,
        files=files,
        output=output,
        formats=split_commas(formats, "--format", list(NORMALS)),
        auto_mask=auto_mask,
        surface=surface,
        html=html,
        asked=options,
        maps=[] if maps is None else split_commas(maps, "--maps", list(MAPS)),
        convention=convention.value,
        n_lights=n_lights,
        seed=seed,
        light_indices=indices,
        method=method,
        options=MethodOptions(weights, rotations, batch_size, device.value, precision.value),
        talk=Talk(quiet=quiet),
    )
    if "confidence" in job.maps:
        _ = job.estimator  # refuses methods that do not tell it before anything is read
    reports, exit_code = [], 0
    for folder in captures:
        if folder in finished:
            reports.append(finished[folder])
            job.talk.say(f"{output / capture_name(folder)}: finished before, left as it is")
            continue
        try:
            source, capture, read_seconds = job.read(folder)
        except (InputError, UsageError) as error:
            if len(captures) == 1:
                raise
            exit_code = InputError.exit_code
            print(f"splinecli: {error}", file=sys.stderr)
            report = {"capture": capture_name(folder), "error": str(error)}
        else:
            report = job.estimate(source, capture, read_seconds)
            if not (quiet or as_json):
                print(_summary(report, output))
        reports.append(report)
    if len(captures) > 1 or has_index(output):
        write_text(output / INDEX, index_page(with_earlier(reports, output)))
    if len(captures) > 1:
        _say_how_it_went(reports, len(finished), output, job.talk)
    if as_json:
        print(json.dumps(reports[0] if len(captures) == 1 else reports, indent=2))
    return exit_code


def _say_how_it_went(reports: Sequence[dict[str, Any]], n_finished: int, output: Path, talk: Talk) -> None:
    from splinecli.results.index import HEADER, INDEX, row_of

    good = [row_of(report) for report in reports if "error" not in report]
    if good:
        columns = [column for column in zip(HEADER, *good, strict=True) if any(column[1:])]
        talk.table(list(zip(*columns, strict=True)))
    counts = f"{len(good) - n_finished} done, {n_finished} finished before, {len(reports) - len(good)} bad"
    talk.say(f"{len(reports)} captures: {counts}; see {output / INDEX}")


def _refuse_same_names(captures: list[Path]) -> None:
    from splinecli.capture import capture_name

    seen: dict[str, Path] = {}
    for folder in captures:
        other = seen.setdefault(capture_name(folder), folder)
        if other is not folder:
            raise UsageError(
                f"{other} and {folder} have the same name, so their results would overwrite each other",
                hint="Run them one by one with different -o",
            )


def _summary(report: dict[str, Any], output: Path) -> str:
    errors, expected = report["angular_error_deg"], report["expected_under_5"]
    scored = ""
    if errors is not None:
        scored = f", MAE {errors['mean']:.2f} deg (median {errors['median']:.2f})"
    elif expected is not None:
        scored = f", {expected:.0%} of them likely within 5 deg"
    counts = f"{report['n_pixels']} pixels, {report['n_lights']} lights"
    return f"{output / report['capture']}: {counts}, {report['method']}{scored}"
