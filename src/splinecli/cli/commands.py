"""The commands calibrate, integrate, evaluate, prepare, train and import-weights."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from splinecli.cli.console import Messages, print_report
from splinecli.errors import InputError, OutputError, printable
from splinecli.workshop import training

if TYPE_CHECKING:
    from splinecli.evaluation.protocol import Evaluation
    from splinecli.pipeline.options import CalibrateOptions, EvaluateOptions, IntegrateOptions
    from splinecli.workshop.options import ImportOptions, PrepareOptions, TrainOptions
    from splinecli.workshop.training.loop import Trainer
    from splinecli.workshop.training.run_files import Metrics


def calibrate(options: CalibrateOptions) -> None:
    """Measure light directions from images of mirror balls.

    A BALL is a folder with one image for each light, in the order of the lights. The outline of the
    ball comes from --circle or a mask (--mask, or a file named mask in the folder). Otherwise it is
    detected in an image named ref, or in the mean of all images. The brightest spot in the ball is
    treated as the reflection of the lamp. Directions of several balls are averaged.

    Writes OUT/light_directions.txt for infer --lights, calibration.png to check the result by eye,
    and calibration.json. With a gray ball or card, it also writes
    light_intensities.txt, the relative light intensities. If the lamps are near, the camera is
    known, and there are at least two balls or one ball at two places, it also writes
    light_positions.txt, pixel_size.txt and camera_matrix.txt for infer --light-positions.
    """
    from splinecli.pipeline.calibrate import DIRECTIONS, calibrate_lights

    report = calibrate_lights(options, Messages(quiet=options.quiet))
    print_report(
        report, str(options.output / DIRECTIONS), as_json=options.as_json, quiet=options.quiet
    )


def integrate(options: IntegrateOptions) -> None:
    """Integrate a normal map into a depth map and a mesh.

    Uses bilateral normal integration. The surface may break at edges, where the normals are
    inconsistent. Without a camera matrix, the depth map has heights towards the camera in pixels,
    with mean zero. With one, it has depths along the viewing axis, of unknown scale.

    Writes OUT/mesh.glb and mesh.ply (or .obj, .stl, .3mf), depth.npy and depth.tiff, which are NaN
    outside the object, depth.png and surface.json.
    """
    from splinecli.pipeline.integrate import integrate_normal_map, summary_line

    report = integrate_normal_map(options, Messages(quiet=options.quiet))
    print_report(
        report, summary_line(options, report), as_json=options.as_json, quiet=options.quiet
    )


def evaluate(options: EvaluateOptions) -> int:
    """Compare methods by their mean angular error over random draws of K lights.

    All methods use the same draws. Captures are read as infer reads them, but faults are not
    corrected; --as-stored reproduces published tables.

    Prints a table. Writes results.json, results.csv, table.md, table.tex and report.html to OUT,
    and a plot if you give several K or SIGMA. OUT/trials.jsonl stores finished trials: run the
    command again to continue, or to add trials, methods or lights. A capture that cannot be scored
    is skipped with a message, and the exit code is then 3.
    """
    from splinecli.pipeline.evaluate import evaluate_captures

    cluster = options.cluster.replace(gpu=options.device == "cuda")
    talk = Messages(quiet=options.quiet)
    outcome = evaluate_captures(options.replace(cluster=cluster), talk)
    for entry in outcome.document["skipped"]:
        talk.error(f"{entry['capture']} was skipped: {entry['reason']}")
    for problem in outcome.figure_problems:
        talk.error(f"no {'figure or relighting' if options.relight else 'figure'}: {problem}")
    for warning in outcome.warnings:
        talk.warn(warning)
    for note in outcome.document["notes"]:
        talk.say(f"splinecli: note: {note}")
    if options.as_json:
        print(json.dumps(outcome.document, indent=2))
    elif not options.quiet:
        for evaluation in outcome.evaluations:
            _print_table(evaluation)
        for relit in outcome.document.get("relighting", ()):
            kinds = [
                f"{kind} {relit[kind]['psnr_db']:.1f} dB"
                for kind in ("material", "lambertian", "nearest")
            ]
            lights = f"from {len(relit['lights'])} lights"
            print(f"relighting {relit['capture']} {lights}, {relit['method']}: {', '.join(kinds)}")
    return InputError.exit_code if outcome.document["skipped"] or outcome.figure_problems else 0


def _print_table(evaluation: Evaluation) -> None:
    """Print methods by captures, or captures by methods if the terminal is too narrow."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from splinecli.evaluation.tables import best_cells, caption, table_rows

    rows = table_rows(evaluation)
    best = best_cells(rows)
    cells = [
        [Text(cell, "bold" if (r, c) in best else "") for c, cell in enumerate(row)]
        for r, row in enumerate(rows)
    ]
    console = Console(highlight=False)
    if (
        sum(max(len(row[column]) for row in rows) + 3 for column in range(len(rows[0])))
        > console.width
    ):
        cells = [list(column) for column in zip(*cells, strict=True)]
    table = Table(box=box.SIMPLE_HEAD)
    for column, name in enumerate(cells[0]):
        table.add_column(name, justify="right" if column else "left", no_wrap=True)
    for row in cells[1:]:
        table.add_row(*row)
    print(caption(evaluation))
    # Do not cut off a table that is too wide.
    widest = console.measure(table, options=console.options.update(max_width=10_000)).maximum
    Console(highlight=False, width=max(console.width, widest)).print(table, crop=False)


def prepare(options: PrepareOptions) -> int:
    """Make a pixel set, the training data of `splinecli train SET`.

    A pixel set has the true normal of each pixel and its observations under all lights. Writes
    SET/manifest.json, a folder for each capture and scene, and the overview SET/contact_sheet.png.
    The same command continues after an interruption, and adds to an existing set. Captures that
    cannot be read are reported and skipped. Rendering needs the extra 'render'.
    """
    from splinecli.pipeline.batch import worst_exit_code
    from splinecli.workshop.prepare import prepare_pixel_set

    summary = prepare_pixel_set(options, Messages(quiet=options.quiet))
    entries = "1 entry" if summary["entries"] == 1 else f"{summary['entries']} entries"
    scenes = "1 scene" if summary["scenes"] == 1 else f"{summary['scenes']} scenes"
    in_words = (
        f"{summary['set']}: {entries} of {scenes}, {summary['n_pixels']} pixels,"
        f" {summary['bytes'] / 1e6:.0f} MB; overview in {summary['contact_sheet']}"
    )
    print_report(
        summary,
        *([in_words] if summary["entries"] else []),
        as_json=options.as_json,
        quiet=options.quiet,
    )
    return worst_exit_code(capture["exit_code"] for capture in summary["skipped"])


def import_weights(options: ImportOptions) -> None:
    """Convert the checkpoints of the authors' SPLINE-Net (PyTorch) to a weight file.

    Pass the weight file to other commands with --weights. Both checkpoints must come from the same
    training step, such as 200000-G.ckpt and 200000-D.ckpt. Only tensors are read from them; code in
    them is not run.
    """
    output = options.output
    if output.is_dir():
        raise OutputError("found a folder, expected a file", path=output, hint="Pass a file to -o")
    if output.exists() and not options.overwrite:
        raise OutputError(
            "the file exists already", path=output, hint="Add --overwrite, or choose another -o"
        )

    from splinecli.workshop.import_weights import import_official
    from splinecli.workshop.save_weights import save_weights

    save_weights(import_official(options.li_net, options.ne_net), output)
    if not options.quiet:
        print(printable(output))


def train(options: TrainOptions) -> None:
    """Train LI-Net and NE-Net, or with --preset refine a refinement net.

    Without a SET, the pixels are generated during training; a refinement net needs a SET. Writes
    weights.safetensors (for --weights of other commands), checkpoint.safetensors, config.json,
    metrics.csv, curves.png and maps.png to RUN. After Ctrl-C, --resume continues
    from the checkpoint. Settings come from the preset, then from --config, then from the other
    options. With torchrun, several processes train together.
    """
    from splinecli.workshop.training.config import parse_parameter, parse_sources
    from splinecli.workshop.training.loop import configure_run, open_run

    changes: list[dict[str, Any]] = []  # in ascending order of precedence
    if options.sets or options.generator_weight is not None:
        changes.append({"sources": parse_sources(options.sets, options.generator_weight)})
    given = {"pixels": options.n_lights, "start_from": options.start_from}
    changes += [{name: value} for name, value in given.items() if value is not None]
    changes += [parse_parameter(text) for text in options.param]
    if options.seed is not None:
        changes.append({"seed": options.seed})
    settings, resume = configure_run(
        options.output, options.preset, options.config, changes, resume=options.resume
    )
    if options.steps is not None:
        settings = replace(settings, steps=options.steps, minutes=0.0)
    if options.minutes is not None:
        settings = replace(settings, minutes=options.minutes)
    messages = Messages(quiet=options.quiet)
    how: dict[str, Any] = {
        "resume": resume,
        "tensorboard": options.tensorboard,
        "observer": messages,
    }
    with open_run(settings, options.output, options.device, **how) as trainer:
        _run(trainer, Messages(quiet=options.quiet or not trainer.workers.leads))
        if not options.quiet and trainer.workers.leads:
            print(printable(options.output / training.WEIGHTS))


def _run(trainer: Trainer, messages: Messages) -> None:
    if single := trainer.task.sets.single_scene_sets:
        names = ", ".join(single)
        messages.warn(
            f"{names}: the set has only one scene, so training and validation use the same pixels"
        )
    if trainer.workers.leads and trainer.log.set_aside:
        messages.warn(f"metrics.csv was damaged and has been renamed to {trainer.log.set_aside}")
    shown = trainer.progress
    if shown >= 1:
        messages.say(
            f"{trainer.folder}: the run is already complete. To continue it, increase --steps or"
            " --minutes."
        )
    with messages.progress("training", 1.0, start=shown) as advance:

        def report(progress: float, metrics: Metrics) -> None:
            nonlocal shown
            advance(progress - shown, _losses(metrics))
            shown = progress
            # A terminal shows a progress bar. Elsewhere, print a line for each checkpoint.
            if metrics.validation_deg is not None and (progress >= 1 or not sys.stderr.isatty()):
                messages.say(f"step {metrics.step}, {_losses(metrics)}")

        trainer.run(report)


def _losses(metrics: Metrics) -> str:
    """Return the losses as text.

    Example: "1.5 minutes: loss 0.412, map 0.051, 8.31 deg, 9.02 deg in validation".
    """
    validation = (
        ""
        if metrics.validation_deg is None
        else f", {metrics.validation_deg:.2f} deg in validation"
    )
    on_map = "" if metrics.map_error is None else f" map {metrics.map_error:.3f},"
    return (
        f"{metrics.minutes:.1f} minutes: loss {metrics.loss:.3f},{on_map} {metrics.angle_deg:.2f}"
        f" deg{validation}"
    )
