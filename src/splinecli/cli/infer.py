"""`splinecli infer`: captures in, normal maps out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splinecli.cli import choices
from splinecli.cli.console import Messages, print_lines
from splinecli.cli.documents import Documents, printed_documents
from splinecli.cli.options import computing, distribution, inputs, outputs
from splinecli.cli.options.values import (
    Device,
    FirstLight,
    LightForm,
    NormalConvention,
    Precision,
    parse_cluster,
    parse_indices,
    split_commas,
)
from splinecli.cli.records import record_from
from splinecli.errors import UsageError, printable

if TYPE_CHECKING:
    from splinecli.pipeline.member import Outcome, Redo
    from splinecli.results.index import Row


_WORDS = {
    "done": "done",
    "skipped": "already done",
    "changed": "changed but kept",
    "missing": "missing",
    "failed": "failed",
}
"""How the last line counts the outcomes."""


def infer(
    captures: list[Path] = inputs.CAPTURES,
    lights: Path | None = inputs.LIGHTS,
    first_light: FirstLight | None = inputs.FIRST_LIGHT,
    intensities: Path | None = inputs.INTENSITIES,
    refine_lights: bool = inputs.REFINE_LIGHTS,
    light_positions: Path | None = inputs.LIGHT_POSITIONS,
    light_distance: float | None = inputs.LIGHT_DISTANCE,
    pixel_size: float | None = inputs.PIXEL_SIZE_OF_SURFACE,
    object_width: float | None = inputs.OBJECT_WIDTH,
    camera_matrix: Path | None = inputs.LAMP_CAMERA_MATRIX,
    mask: Path | None = inputs.MASK,
    auto_mask: bool = inputs.AUTO_MASK,
    crop: str | None = inputs.CROP,
    scale: str | None = inputs.SCALE,
    ground_truth: Path | None = inputs.GROUND_TRUTH,
    transfer: str = inputs.TRANSFER,
    ambient: Path | None = inputs.AMBIENT,
    flat_field: Path | None = inputs.FLAT_FIELD,
    white_level: float | None = inputs.WHITE_LEVEL,
    light_frame: str | None = inputs.LIGHT_FRAME,
    lights_format: LightForm = inputs.LIGHTS_FORMAT,
    as_stored: bool = inputs.AS_STORED,
    output: Path = outputs.INFER_FOLDER,
    method: str = computing.METHOD,
    weights: str | None = computing.WEIGHTS,
    n_lights: int | None = inputs.NUMBER_OF_LIGHTS,
    seed: int = inputs.SEED,
    light_indices: str | None = inputs.LIGHT_INDICES,
    distil: bool | None = computing.DISTIL,
    device: Device = computing.DEVICE,
    precision: Precision = computing.PRECISION,
    formats: str = outputs.NORMAL_FORMATS,
    maps: str | None = outputs.MAPS,
    html: bool = outputs.HTML,
    surface: bool = outputs.SURFACE,
    stiffness: float = computing.STIFFNESS,
    convention: NormalConvention = outputs.CONVENTION,
    overwrite: bool = outputs.OVERWRITE,
    update: bool = outputs.UPDATE,
    strict: bool = outputs.STRICT,
    workers: str = distribution.WORKERS,
    cluster: str | None = distribution.CLUSTER,
    shard: str | None = distribution.SHARD,
    as_json: bool = outputs.JSON_LIST,
    as_json_lines: bool = outputs.JSON_LINES,
    quiet: bool = outputs.QUIET,
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
    from splinecli.pipeline.capture_list import Shard
    from splinecli.pipeline.infer_options import InferOptions

    with printed_documents(as_list=as_json, as_lines=as_json_lines) as documents:
        if as_json and as_json_lines:
            raise UsageError("--json and --jsonl contradict each other", hint="Leave one out")
        if overwrite and update:
            raise UsageError("--overwrite and --update contradict each other", hint="Leave one out")
        options = record_from(
            InferOptions,
            given,
            seed=seed if n_lights is not None else 0,
            light_indices=None if light_indices is None else _indices(light_indices),
            formats=tuple(split_commas(formats, "--format", choices.normal_formats())),
            maps=() if maps is None else tuple(split_commas(maps, "--maps", choices.maps())),
        )
        messages = Messages(quiet=quiet)
        redo: Redo = "all" if overwrite else "changed" if update else "nothing"
        batch = infer_batch(
            captures,
            options,
            messages,
            redo=redo,
            shard=None if shard is None else Shard.parse(shard),
            cluster=parse_cluster(workers, cluster, gpu=device is Device.cuda),
        )
        return _show_all(batch, output, messages, documents, summaries=not (quiet or as_json or as_json_lines))


def _show_all(
    outcomes: Iterable[Outcome],
    output: Path,
    messages: Messages,
    documents: Documents,
    *,
    summaries: bool,
) -> int:
    """Print what becomes of each capture, and return the exit code."""
    from splinecli.pipeline.batch import worst_exit_code
    from splinecli.results.index import row_of

    statuses: Counter[str] = Counter()
    codes: set[int] = set()
    rows: list[Row] = []
    for outcome in outcomes:
        documents.add(outcome.report)
        _show(outcome, output, messages, with_summary=summaries)
        statuses[outcome.status] += 1
        codes.add(outcome.exit_code)
        if outcome.status in ("done", "skipped"):
            rows.append(row_of(outcome.report))
    if statuses.total() > 1:
        _show_table(rows, statuses, output, messages)
    return worst_exit_code(codes)


def _indices(text: str) -> tuple[int, ...]:
    return tuple(parse_indices(text, "--light-indices"))


def _show(outcome: Outcome, output: Path, messages: Messages, *, with_summary: bool) -> None:
    """Print what became of a capture. Failures are printed even with --quiet."""
    if outcome.status == "done":
        if with_summary:
            print(printable(_summary(outcome.report, output)))
    elif outcome.status == "skipped":
        messages.say(f"{output / outcome.capture}: already done, skipped")
    else:
        if outcome.trace:
            print_lines(outcome.trace)
        messages.error(outcome.report["error"])


def _show_table(rows: Sequence[Row], statuses: Mapping[str, int], output: Path, messages: Messages) -> None:
    from splinecli.results.index import HEADER, INDEX

    if rows:
        columns = [column for column in zip(HEADER, *rows, strict=True) if any(column[1:])]
        messages.table(list(zip(*columns, strict=True)))
    text = ", ".join(f"{statuses[status]} {words}" for status, words in _WORDS.items() if statuses[status])
    messages.say(f"{sum(statuses.values())} captures: {text}; see {output / INDEX}")


def _summary(report: dict[str, Any], output: Path) -> str:
    from splinecli.capture.capture_warnings import PROBABLY_WRONG

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
