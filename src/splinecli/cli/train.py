"""`splinecli train` and `import-weights`: weights from training, or from the authors' checkpoints."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from typer import Argument, Option

from splinecli.cli import shared
from splinecli.cli.console import Messages
from splinecli.errors import OutputError, UsageError, printable
from splinecli.training import defaults

if TYPE_CHECKING:
    from splinecli.training.config_files import Settings
    from splinecli.training.loop import Trainer
    from splinecli.training.run_files import Metrics


def import_weights(
    li_net: Path = Argument(..., metavar="G.ckpt", help="The authors' LI-Net, which they call the generator."),
    ne_net: Path = Argument(..., metavar="D.ckpt", help="The authors' NE-Net, which they call the discriminator."),
    output: Path = Option(..., "--output", "-o", metavar="FILE.safetensors", help="The weight file to write."),
    overwrite: bool = Option(False, "--overwrite", help="Replace an existing file."),
    quiet: bool = shared.QUIET,
) -> None:
    """Turn the checkpoints of the authors' SPLINE-Net (PyTorch) into a weight file.

    Other commands take the weight file with --weights. Both checkpoints must come from the same training
    step, such as 200000-G.ckpt and 200000-D.ckpt. Only tensors are read from them; code in them is not run.
    """
    if output.is_dir():
        raise OutputError("is a folder, expected a file", path=output, hint="Name a file with -o")
    if output.exists() and not overwrite:
        raise OutputError("exists already", path=output, hint="Add --overwrite, or choose another place with -o")

    from splinecli.networks.weights import import_official, save_weights

    save_weights(import_official(li_net, ne_net), output)
    if not quiet:
        print(printable(output))


def train(
    output: Path = Option(
        ...,
        "--output",
        "-o",
        metavar="RUN",
        help=f"Folder of the run. Its files are updated every {defaults.CHECKPOINT_SECONDS} seconds.",
    ),
    sets: list[Path] | None = Argument(None, metavar="SET", help="Pixel sets made by 'splinecli prepare'."),
    preset: str | None = Option(
        None,
        metavar="NAME",
        help=f"Settings to begin with: {', '.join(defaults.PRESET_NAMES)}. [default: {defaults.DEFAULT_PRESET}]",
        autocompletion=lambda: list(defaults.PRESET_NAMES),
    ),
    config: Path | None = Option(None, metavar="FILE", help="Settings from a TOML file or a run's config.json."),
    param: list[str] | None = Option(
        None, metavar="NAME=VALUE", help="One setting, such as pixels.wall_share=0.3. May be repeated."
    ),
    start_from: str | None = Option(
        None,
        metavar="NAME|FILE",
        help="Begin with these weights. [default: random weights; preset refine: spline-net]",
        autocompletion=shared.complete_weights,
    ),
    generator_weight: float | None = Option(
        None, metavar="W", min=0, help="Weight of generated pixels; each SET has weight 1. [default: 0; 1 without SET]"
    ),
    n_lights: str | None = Option(
        None, metavar="K|MIN-MAX", help="Number of lights of each pixel. [default: the preset's]"
    ),
    steps: int | None = Option(
        None,
        metavar="N",
        min=1,
        help=f"Train for N steps. [default: {defaults.DEFAULT_STEPS:,}; presets paper: {defaults.PAPER_STEPS:,},"
        f" refine: {defaults.REFINE_STEPS:,}]",
    ),
    minutes: float | None = Option(
        None,
        metavar="M",
        min=0.01,
        help="Train for M minutes instead of a number of steps. [default: train for --steps]",
    ),
    resume: bool = Option(False, "--resume", help="Continue from the run's checkpoint."),
    seed: int | None = Option(None, metavar="S", min=0, max=2**32 - 1, help="Seed of the run. [default: 0]"),
    tensorboard: bool = Option(
        False, "--tensorboard", help="Also write RUN/tensorboard (needs the extra 'tensorboard')."
    ),
    device: shared.Device = shared.DEVICE,
    quiet: bool = shared.QUIET,
) -> None:
    """Train LI-Net and NE-Net, or with --preset refine a refinement net.

    Without a SET, the pixels are generated during training; a refinement net needs a SET. Writes
    weights.safetensors, which --weights of other commands takes, checkpoint.safetensors, config.json, metrics.csv,
    curves.png and maps.png into RUN. After Ctrl-C, --resume continues from the checkpoint. Settings come from the
    preset, then from --config, then from the other options. With torchrun, several processes train together.
    """
    if steps is not None and minutes is not None:
        raise UsageError("--steps and --minutes contradict each other", hint="Leave one out")

    from splinecli.training.config_files import parse_light_counts, parse_parameter, parse_sources
    from splinecli.training.loop import configure_run, open_run

    changes: list[Settings] = []  # in the order of their precedence
    if sets or generator_weight is not None:
        changes.append({"sources": parse_sources(sets or [], generator_weight)})
    if n_lights is not None:
        changes.append({"pixels": parse_light_counts(n_lights)})
    if start_from is not None:
        changes.append({"start_from": start_from})
    changes += [parse_parameter(text) for text in param or []]
    if seed is not None:
        changes.append({"seed": seed})
    settings, resume = configure_run(output, preset, config, changes, resume=resume)
    if steps is not None:
        settings = replace(settings, steps=steps, minutes=0.0)
    if minutes is not None:
        settings = replace(settings, minutes=minutes)
    messages = Messages(quiet=quiet)
    start = open_run(
        settings,
        output,
        device.value,
        resume=resume,
        tensorboard=tensorboard,
        warn=messages.warn,
        say=messages.say,
    )
    with start as trainer:
        _run(trainer, Messages(quiet=quiet or not trainer.workers.leads))
        if not quiet and trainer.workers.leads:
            print(printable(output / defaults.WEIGHTS))


def _run(trainer: Trainer, messages: Messages) -> None:
    if single := trainer.task.sets.single_scene_sets:
        names = ", ".join(single)
        messages.warn(f"{names}: the set has a single scene, so training and validation use the same pixels")
    if trainer.workers.leads and trainer.log.set_aside:
        messages.warn(f"metrics.csv was damaged and is now {trainer.log.set_aside}")
    shown = trainer.progress
    if shown >= 1:
        messages.say(f"{trainer.folder}: the run is at its end already. Give it more --steps or --minutes to go on.")
    with messages.progress("training", 1.0, start=shown) as advance:

        def report(progress: float, metrics: Metrics) -> None:
            nonlocal shown
            advance(progress - shown, _losses(metrics))
            shown = progress
            # A terminal shows the bar. A log file gets a line with each checkpoint.
            if metrics.validation_deg is not None and (progress >= 1 or not sys.stderr.isatty()):
                messages.say(f"step {metrics.step}, {metrics.pixels} pixels, {_losses(metrics)}")

        trainer.run(report)


def _losses(metrics: Metrics) -> str:
    """Return the losses in words. Example: "1.5 minutes: loss 0.412, map 0.051, 8.31 deg, 9.02 deg in validation"."""
    validation = "" if metrics.validation_deg is None else f", {metrics.validation_deg:.2f} deg in validation"
    on_map = "" if metrics.map_error is None else f" map {metrics.map_error:.3f},"
    return f"{metrics.minutes:.1f} minutes: loss {metrics.loss:.3f},{on_map} {metrics.angle_deg:.2f} deg{validation}"
