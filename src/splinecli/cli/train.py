"""`splinecli train`: LI-Net and NE-Net on pixel sets, on the online pixel generator, or on both."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import Device, DeviceOption, QuietOption, complete_weights
from splinecli.errors import UsageError

if TYPE_CHECKING:
    from splinecli.training.config import TrainingConfig
    from splinecli.training.run_log import Metrics


def train(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RUN", help="Folder of the run.")],
    sets: Annotated[
        list[Path] | None, typer.Argument(metavar="SET", help="Pixel sets made by 'splinecli prepare'.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="compact, paper or cnn-ps. [default: compact]",
            # Written out, for the presets themselves import torch.
            autocompletion=lambda: ["compact", "paper", "cnn-ps"],
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings (TOML, or a run's config.json).")
    ] = None,
    param: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="One setting, such as pixels.wall_share=0.3; repeatable."),
    ] = None,
    start_from: Annotated[
        str | None,
        typer.Option(
            metavar="WEIGHTS",
            help="Begin with these weights, a shipped name or a file.",
            autocompletion=complete_weights,
        ),
    ] = None,
    generator_weight: Annotated[
        float | None,
        typer.Option(
            metavar="W",
            min=0,
            help="Share of generated pixels, where a SET's is 1. [default: 0; 1 without SET]",
        ),
    ] = None,
    n_lights: Annotated[
        str | None, typer.Option(metavar="K|MIN-MAX", help="Lights of each pixel. [default: the preset's]")
    ] = None,
    steps: Annotated[int | None, typer.Option(metavar="N", min=1, help="Length in steps.")] = None,
    minutes: Annotated[
        float | None, typer.Option(metavar="M", min=0.01, help="Length in minutes, instead of steps.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run's checkpoint.")] = False,
    seed: Annotated[
        int | None, typer.Option(metavar="S", min=0, max=2**32 - 1, help="Seed of the run. [default: 0]")
    ] = None,
    tensorboard: Annotated[
        bool,
        typer.Option("--tensorboard", help="Also write RUN/tensorboard (needs the extra 'tensorboard')."),
    ] = False,
    device: DeviceOption = Device.auto,
    quiet: QuietOption = False,
) -> None:
    """Train LI-Net and NE-Net.

    Without a SET, on pixels that are made as they are needed. Writes RUN/weights.safetensors (give it to --weights),
    checkpoint.safetensors, config.json, metrics.csv, curves.png and maps.png, and renews them every minute. Ctrl-C
    loses at most that; --resume goes on. Settings come from the preset, then the file, then the options. Under
    torchrun all processes train together.
    """
    from splinecli.devices import choose_device, use_available_cores
    from splinecli.files import check_writable, held_folder
    from splinecli.training.config_files import parse_parameter
    from splinecli.training.defaults import CHECKPOINT, WEIGHTS
    from splinecli.training.distributed import is_to_go_on, join_workers, leave_workers
    from splinecli.training.loop import Trainer

    if steps is not None and minutes is not None:
        raise UsageError("--steps and --minutes exclude each other")
    changes: list[dict[str, Any]] = []
    if sets or generator_weight is not None:
        changes.append({"sources": _sources(sets or [], generator_weight)})
    if n_lights is not None:
        changes.append({"pixels": _light_counts(n_lights)})
    if start_from is not None:
        changes.append({"start_from": start_from})
    changes += [parse_parameter(text) for text in param or []]
    if seed is not None:
        changes.append({"seed": seed})
    # Under torchrun's --max-restarts the same command begins a run and goes on with it.
    resume = resume or (is_to_go_on() and (output / CHECKPOINT).exists())
    settings = _configure(output, preset, config, changes, resume=resume)
    if steps is not None:
        settings = replace(settings, steps=steps, minutes=0.0)
    if minutes is not None:
        settings = replace(settings, minutes=minutes)
    check_writable(output)
    use_available_cores()
    workers, own_device = join_workers(choose_device(device.value))
    talk = Messages(quiet=quiet or not workers.leads)
    with ExitStack() as stack:
        stack.callback(leave_workers)
        workers.shards(settings.shards)  # refused before the folder is made
        if workers.leads:
            stack.enter_context(held_folder(output))
        trainer = Trainer(
            settings, output, own_device, resume=resume, workers=workers, tensorboard=tensorboard
        )
        if trainer.single_scene_sets:
            names = ", ".join(trainer.single_scene_sets)
            talk.warn(
                f"{names}: a single scene, of which nothing is held back: validation is on training pixels"
            )
        with talk.progress("training", 1.0, start=trainer.progress) as advance:
            shown = trainer.progress

            def report(progress: float, metrics: Metrics) -> None:
                nonlocal shown
                advance(progress - shown, _losses(metrics))
                shown = progress
                # On a terminal the bar says it; a log wants a line each time something was saved.
                if metrics.validation_deg is not None and (progress >= 1 or not sys.stderr.isatty()):
                    talk.say(f"step {metrics.step}, {metrics.pixels} pixels, {_losses(metrics)}")

            trainer.run(report)
    if not quiet and workers.leads:
        print(output / WEIGHTS)


def _configure(
    output: Path,
    preset: str | None,
    file: Path | None,
    changes: list[dict[str, Any]],
    *,
    resume: bool,
) -> TrainingConfig:
    from splinecli.training.checkpoint import read_checkpoint_config
    from splinecli.training.config_files import configure, configure_resumed
    from splinecli.training.defaults import CHECKPOINT

    if not resume:
        return configure(preset, file, changes)
    begun = read_checkpoint_config(output / CHECKPOINT)
    return configure_resumed(begun, output / CHECKPOINT, preset, file, changes)


def _sources(sets: list[Path], generator_weight: float | None) -> dict[str, float]:
    from splinecli.training.config import GENERATOR

    weights = {str(path): 1.0 for path in sets}
    share = generator_weight if generator_weight is not None else 0.0 if sets else 1.0
    return {**weights, GENERATOR: share} if share else weights


def _light_counts(text: str) -> dict[str, int]:
    low, dash, high = text.partition("-")
    try:
        least, most = int(low), int(high if dash else low)
    except ValueError:
        raise UsageError(
            f"--n-lights is {text!r}; expected a number such as 10, or a range such as 4-96"
        ) from None
    if not 3 <= least <= most:
        raise UsageError(f"--n-lights is {text!r}; expected at least 3 lights, the smaller number first")
    # 30 % of the pixels have the usual number: the published one where it is in the range.
    return {"min_lights": least, "max_lights": most, "usual_lights": min(max(10, least), most)}


def _losses(metrics: Metrics) -> str:
    checked = "" if metrics.validation_deg is None else f", {metrics.validation_deg:.2f} deg in validation"
    on_map = "" if metrics.map_error is None else f" map {metrics.map_error:.3f},"
    return f"{metrics.minutes:.1f} minutes: loss {metrics.loss:.3f},{on_map} {metrics.angle_deg:.2f} deg{checked}"
