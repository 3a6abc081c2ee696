"""`splinecli infer`, `watch` and `info`: captures in, normal maps out, or what to expect of them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import typer
from typer import Argument, Option

from splinecli.capture.files import MAPS, NORMALS, SCALED_MAPS
from splinecli.capture.formats.numbers import to_number
from splinecli.capture_warnings import PROBABLY_WRONG
from splinecli.cli import shared
from splinecli.cli.console import Messages, print_lines, print_report, printed_documents
from splinecli.errors import InputError, UsageError, printable
from splinecli.methods import method_names
from splinecli.results.pages import HEADER, INDEX, Entry, Row

if TYPE_CHECKING:
    from splinecli.pipeline.batch import Outcome, Redo


_WORDS = {"skipped": "already done", "changed": "changed but kept"}  # of the last line, for these outcomes


def infer(
    captures: list[Path] = Argument(
        ..., metavar="CAPTURE", help="Folders with the images of one object each, or films."
    ),
    lights: Path | None = shared.LIGHTS,
    first_light: str | None = shared.FIRST_LIGHT,
    intensities: Path | None = shared.INTENSITIES,
    refine_lights: bool = shared.REFINE_LIGHTS,
    light_positions: Path | None = shared.LIGHT_POSITIONS,
    light_distance: float | None = shared.LIGHT_DISTANCE,
    pixel_size: float | None = Option(
        None,
        metavar="S",
        help=f"{shared.PIXEL_SIZE} With --surface: in millimetres, as the lamps then are, for a"
        " surface in millimetres.",
    ),
    object_width: float | None = shared.OBJECT_WIDTH,
    camera_matrix: Path | None = shared.CAMERA_MATRIX,
    mask: Path | None = shared.MASK,
    auto_mask: bool = Option(
        False, "--auto-mask", help="If there is no mask, find the object in the images and write found_mask.png."
    ),
    crop: str | None = shared.CROP,
    scale: str | None = shared.SCALE,
    ground_truth: Path | None = shared.GROUND_TRUTH,
    transfer: str = shared.TRANSFER,
    ambient: Path | None = shared.AMBIENT,
    flat_field: Path | None = shared.FLAT_FIELD,
    white_level: float | None = shared.WHITE_LEVEL,
    light_frame: str | None = shared.LIGHT_FRAME,
    lights_format: shared.LightForm = shared.LIGHTS_FORMAT,
    as_stored: bool = shared.AS_STORED,
    output: Path = Option(Path("out"), "--output", "-o", metavar="OUT", help="Write results to OUT/<capture name>/."),
    method: str = Option(
        "spline-net",
        metavar="METHOD",
        help=f"Method to use: {shared.listed(method_names())}.",
        autocompletion=method_names,
    ),
    weights: str | None = shared.WEIGHTS,
    n_lights: int | None = Option(None, metavar="K", help="Use K lights drawn at random. [default: all]"),
    seed: int = shared.SEED,
    light_indices: str | None = Option(
        None, metavar="I,J,...", help="Use these lights, counted from 0. Plots and warnings count from 1."
    ),
    distil: bool | None = Option(
        None,
        "--distil/--exact",
        help="Let a small network learn the method on a sample of the pixels and estimate the rest, or use the method"
        " on every pixel. [default: --distil from 100,000 pixels, else --exact]",
    ),
    device: shared.Device = shared.DEVICE,
    precision: shared.Precision = shared.PRECISION,
    formats: str = Option(
        "png,npy",
        "--format",
        metavar="LIST",
        help=f"Files of the normal map: any of {shared.listed(NORMALS)}. png has 16 bits, png8 has 8, npy and tiff are"
        " float32. With exr (needs the extra 'exr'), albedo and depth are written as EXR, too.",
        autocompletion=shared.complete_list(NORMALS),
    ),
    maps: str | None = Option(
        None,
        metavar="LIST",
        help=f"Further maps to write: any of {shared.listed(MAPS)}. preview is a shaded image. relief:2 sets the height"
        " in pixels that is white in the picture, curvature:0.1 the mean curvature per pixel.",
        autocompletion=shared.complete_list(MAPS),
    ),
    html: bool = Option(
        False, "--html", help="Also write page.html: the maps, and a view of the surface under a light that you move."
    ),
    surface: bool = Option(
        False, "--surface", help="Also write mesh.glb, mesh.ply, and depth.npy, .tiff and .png, as integrate does."
    ),
    stiffness: float = Option(2.0, metavar="K", min=0, help=shared.STIFFNESS),
    convention: shared.NormalConvention = Option(
        shared.NormalConvention.opengl, help="Green channel of the PNG files: opengl is y up, directx is y down."
    ),
    overwrite: bool = shared.OVERWRITE,
    update: bool = shared.UPDATE,
    strict: bool = shared.STRICT,
    workers: str = Option(
        "1",
        metavar="N|auto",
        help="Compute N captures side by side, in processes of this machine (needs the extra 'cluster'). auto chooses"
        " by cores and memory.",
    ),
    cluster: str | None = Option(None, metavar="ADDRESS|FILE", help=shared.CLUSTER.format("Compute")),
    shard: str | None = Option(None, metavar="I/N", help="Process shard I of N: captures I, I+N, I+2N, ..."),
    as_json: bool = Option(False, "--json", help="Print a JSON list of the reports on stdout, and nothing else."),
    as_json_lines: bool = Option(
        False, "--jsonl", help="Print each report as one line of JSON on stdout when its capture ends."
    ),
    quiet: bool = shared.QUIET,
) -> int:
    """Estimate the normal map of each CAPTURE.

    A CAPTURE is a folder with the images of one object. A fixed camera took them under different lights. The light file
    is in the folder, or --lights names it. With --lights estimate, a CAPTURE may be a film. Writes
    OUT/<name>/normals.png, normals.npy and report.json, and error_map.png if there is ground truth. With several
    captures, OUT/index.html links the results.

    Captures that are already done are skipped. If files or options of a capture have changed, infer reports it and
    keeps the old results. --update or --overwrite computes them again. A capture that fails does not stop the others.
    The exit code is that of the most serious failure.
    """
    given = locals()

    from splinecli.pipeline.batch import Shard, infer_batch
    from splinecli.pipeline.infer_options import InferOptions

    with printed_documents(as_list=as_json, as_lines=as_json_lines) as document:
        if as_json and as_json_lines:
            raise UsageError("--json and --jsonl contradict each other", hint="Leave one out")
        if overwrite and update:
            raise UsageError("--overwrite and --update contradict each other", hint="Leave one out")
        options = shared.record_from(
            InferOptions,
            given,
            seed=seed if n_lights is not None else 0,
            light_indices=None if light_indices is None else shared.parse_indices(light_indices, "--light-indices"),
            formats=shared.split_commas(formats, "--format", NORMALS),
            **_split_maps(maps),
        )
        messages = Messages(quiet=quiet)
        redo: Redo = "all" if overwrite else "changed" if update else "nothing"
        batch = infer_batch(
            captures or [],  # none of watch, which only wants the options to be checked
            options,
            messages,
            redo=redo,
            shard=None if shard is None else Shard.parse(shard),
            cluster=shared.parse_cluster(workers, cluster, gpu=device is shared.Device.cuda),
        )
        return _show_all(batch, output, messages, document, summaries=not (quiet or as_json or as_json_lines))


def _split_maps(text: str | None) -> dict[str, Any]:
    """Return the fields of InferOptions for a list such as "albedo,relief:2". Raises UsageError."""
    if text is None:
        return {"maps": ()}
    fields: dict[str, Any] = {}
    names = []
    for item in text.split(","):
        name, colon, scale = (part.strip() for part in item.partition(":"))
        names.append(name)
        if colon:
            if name not in SCALED_MAPS or to_number(scale) is None:
                expected = " or ".join(f"{name}:NUMBER" for name in SCALED_MAPS)
                raise UsageError(f"--maps has {item.strip()!r}; a scale is given as {expected}")
            fields[f"{name}_scale"] = float(scale)
    return {**fields, "maps": shared.split_commas(",".join(names), "--maps", MAPS)}


def _show_all(
    outcomes: Iterable[Outcome],
    output: Path,
    messages: Messages,
    document: Callable[[dict[str, Any]], None],
    *,
    summaries: bool,
) -> int:
    from splinecli.pipeline.batch import Status, worst_exit_code

    statuses: Counter[str] = Counter()
    codes: set[int] = set()
    rows: list[Row] = []
    for outcome in outcomes:
        document(outcome.report)
        if outcome.status == "done":
            if summaries:
                print(printable(_summary(outcome.report, output)))
        elif outcome.status == "skipped":
            messages.say(f"{output / outcome.report['capture']}: already done, skipped")
        else:  # printed even with --quiet
            if outcome.trace:
                print_lines(outcome.trace)
            messages.error(outcome.report["error"])
        statuses[outcome.status] += 1
        codes.add(outcome.exit_code)
        if outcome.status in ("done", "skipped"):
            rows.append(Entry.of(outcome.report).row)
    if statuses.total() > 1:
        if rows:
            columns = [column for column in zip(HEADER, *rows, strict=True) if any(column[1:])]
            messages.table(list(zip(*columns, strict=True)))
        text = ", ".join(f"{statuses[name]} {_WORDS.get(name, name)}" for name in get_args(Status) if statuses[name])
        messages.say(f"{statuses.total()} captures: {text}; see {output / INDEX}")
    return worst_exit_code(codes)


def _summary(report: dict[str, Any], output: Path) -> str:
    errors, expected = report["angular_error_deg"], report["expected_under_5"]
    scored = ""
    if errors is not None:
        scored = f", MAE {errors['mean']:.2f} deg (median {errors['median']:.2f})"
    elif expected is not None:
        doubted = any(warning["code"] in PROBABLY_WRONG for warning in report["warnings"])
        judged = report["capture_judged"] and not doubted
        condition = "" if judged else " if the lights and the images are right"
        scored = f", {expected:.0%} of them likely within 5 deg{condition}"
    counts = f"{report['n_pixels']} pixels, {report['n_lights']} lights"
    return f"{output / report['capture']}: {counts}, {report['method']}{scored}, {report['seconds']['total']:.1f} s"


_LOOK_SECONDS = 1.0  # time between two looks at the folder


def watch(
    context: typer.Context,
    folder: Path = Argument(
        ..., metavar="FOLDER", help="Folder in which captures arrive, a subfolder or film for each."
    ),
    options: list[str] = Argument(None, metavar="-- OPTIONS", help="Options of infer, after two dashes."),
    marker: str | None = Option(
        None, metavar="NAME", help="File that appears in a subfolder when it is complete. [default: see --settle]"
    ),
    settle: float = Option(
        5.0,
        metavar="SECONDS",
        min=0,
        help="A film, or without --marker a subfolder, is complete when nothing in it changed for so long.",
    ),
) -> None:
    """Run infer on each capture that arrives in FOLDER, once it is complete.

    A capture is a subfolder of FOLDER, or a film with --lights estimate. It is computed as by infer with OPTIONS, and
    captures that are already done are skipped, so the command can be stopped and started again at any time. A capture
    that fails does not stop it. It is tried again when its files change. If FOLDER vanishes, the command waits for it.
    Ctrl-C or SIGTERM ends the command, with exit code 130.
    """
    from splinecli.pipeline.incoming import Arrivals

    options = options or []
    infer: Any = context.parent.command.get_command(context.parent, "infer")  # type: ignore[union-attr]
    run = infer.make_context("infer", [*options, "--", str(folder)], parent=context.parent)
    given, output = run.params, run.params["output"].expanduser()
    if given["as_json"]:
        raise UsageError("--json prints one list at the end, and watch has none", hint="Give --jsonl")
    if given["shard"] is not None:
        raise UsageError(
            "--shard splits a list of captures, and watch has none", hint="Watch one folder for each shard"
        )
    if len(given["captures"]) > 1:
        raise UsageError(f"found {given['captures'][0]} after the dashes, expected options of infer")
    if output.resolve() == folder.resolve():
        raise UsageError("the results would lie among the captures", path=output, hint="Give another -o OUT")
    given["captures"] = []
    infer.invoke(run)  # refuses wrong options now, not when the first capture arrives
    arrivals = Arrivals(folder, marker=marker, seconds=settle, without=output)
    messages = Messages(quiet=given["quiet"])
    messages.say(f"{folder}: waiting for captures; Ctrl-C ends")
    ready, is_there = arrivals.take(), True
    while True:
        if ready:
            run.params["captures"] = ready
            infer.invoke(run)
        else:
            time.sleep(_LOOK_SECONDS)
        try:
            ready = arrivals.take()
            if not is_there:
                messages.say(f"{folder}: the folder is there again")
            is_there = True
        except InputError as error:  # a network drive may be away for a moment
            if is_there:
                messages.warn(f"{error} Waiting for it.")
            ready, is_there = [], False


def info(
    capture: Path = Argument(..., metavar="CAPTURE", help="Folder with the images of one object, or a film."),
    lights: Path | None = shared.LIGHTS,
    first_light: str | None = shared.FIRST_LIGHT,
    intensities: Path | None = shared.INTENSITIES,
    light_positions: Path | None = shared.LIGHT_POSITIONS,
    light_distance: float | None = shared.LIGHT_DISTANCE,
    pixel_size: float | None = Option(None, metavar="S", help=shared.PIXEL_SIZE),
    object_width: float | None = shared.OBJECT_WIDTH,
    camera_matrix: Path | None = shared.CAMERA_MATRIX,
    mask: Path | None = shared.MASK,
    crop: str | None = shared.CROP,
    scale: str | None = shared.SCALE,
    ground_truth: Path | None = shared.GROUND_TRUTH,
    transfer: str = shared.TRANSFER,
    ambient: Path | None = shared.AMBIENT,
    flat_field: Path | None = shared.FLAT_FIELD,
    white_level: float | None = shared.WHITE_LEVEL,
    light_frame: str | None = shared.LIGHT_FRAME,
    lights_format: shared.LightForm = shared.LIGHTS_FORMAT,
    auto_mask: bool = Option(False, "--auto-mask", help="If there is no mask, find the object in the images."),
    check_lights: bool = Option(
        False, "--check-lights", help="List other readings of the light file, and how well the images fit each."
    ),
    mended_lights: Path | None = Option(
        None,
        metavar="FILE",
        help="Write the light directions in the order and frame that fit the images best, if the light file does not.",
    ),
    plot: Path | None = Option(None, metavar="FILE", help="Also plot the light directions to a PNG file."),
    overwrite: bool = Option(False, "--overwrite", help="Replace an earlier plot or file of lights."),
    strict: bool = shared.STRICT,
    as_json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
) -> int:
    """Show what `infer` would read from CAPTURE, without running it.

    Prints the layout and files of the capture, the size and bit depth of the images, their white level and exposure,
    the angles of the lights from the camera axis, and the memory and time that infer needs. Writes nothing
    but the plot and the mended lights.
    """
    given = locals()

    from splinecli.pipeline.infer_options import Reading
    from splinecli.pipeline.info import describe_capture, summary_lines

    messages = Messages(quiet=quiet)
    report = describe_capture(
        capture,
        shared.record_from(Reading, given),
        messages,
        plot=plot,
        overwrite=overwrite,
        check_lights=check_lights,
        auto_mask=auto_mask,
        mended_lights=mended_lights,
    )
    print_report(report, *summary_lines(report), as_json=as_json, quiet=quiet)
    wrong = sorted(PROBABLY_WRONG.intersection(report["warning_codes"]))
    if strict and wrong:
        messages.error(f"{capture}: an input is probably wrong ({', '.join(wrong)}), as the warnings say.")
        return InputError.exit_code
    return 0
