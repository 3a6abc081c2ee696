"""`splinecli infer`: captures in, normal maps out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from typer import Argument, Option

from splinecli.capture.formats.numbers import to_number
from splinecli.capture.result_names import MAPS, NORMALS, SCALED_MAPS
from splinecli.capture_warnings import PROBABLY_WRONG
from splinecli.cli import shared
from splinecli.cli.console import Messages, print_lines
from splinecli.cli.failures import printed_documents
from splinecli.errors import UsageError, printable
from splinecli.methods import method_names
from splinecli.results.index import HEADER, INDEX, Entry, Row

if TYPE_CHECKING:
    from splinecli.pipeline.member import Outcome, Redo

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

    from splinecli.pipeline.batch import infer_batch
    from splinecli.pipeline.infer_options import InferOptions
    from splinecli.pipeline.member import Shard

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
    from splinecli.pipeline.batch import worst_exit_code
    from splinecli.pipeline.member import Status

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
