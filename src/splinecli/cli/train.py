"""`splinecli train`: a preset on the online pixel generator."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from splinecli.cli.options import Device, DeviceOption, QuietOption
from splinecli.cli.talk import Talk
from splinecli.errors import UsageError

if TYPE_CHECKING:
    from splinecli.training.config import TrainingConfig
    from splinecli.training.loop import Metrics


def train(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RUN", help="Folder of the run.")],
    preset: Annotated[str, typer.Option(metavar="NAME", help="compact or paper. [default: compact]")] = "",
    steps: Annotated[int | None, typer.Option(metavar="N", min=1, help="Length in steps.")] = None,
    minutes: Annotated[
        float | None, typer.Option(metavar="M", min=0.01, help="Length in minutes, instead of steps.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run's checkpoint.")] = False,
    seed: Annotated[
        int | None, typer.Option(metavar="S", min=0, max=2**32 - 1, help="Seed of the run. [default: 0]")
    ] = None,
    device: DeviceOption = Device.auto,
    quiet: QuietOption = False,
) -> None:
    """Train LI-Net and NE-Net on pixels that are made as they are needed.

    Writes RUN/weights.safetensors (give it to --weights), checkpoint.safetensors, config.json and metrics.csv, and
    renews them every two minutes. Ctrl-C loses at most those; --resume goes on.
    """
    from splinecli.devices import choose_device
    from splinecli.training.loop import WEIGHTS, Trainer

    if steps is not None and minutes is not None:
        raise UsageError("--steps and --minutes exclude each other")
    if resume and (preset or seed is not None):
        raise UsageError("--resume takes preset and seed from the run", hint="Leave --preset and --seed out")
    config = _configure(output, preset or "compact", seed or 0, resume=resume)
    if steps is not None:
        config = replace(config, steps=steps, minutes=0.0)
    if minutes is not None:
        config = replace(config, minutes=minutes)
    trainer = Trainer(config, output, choose_device(device.value), resume=resume)
    talk = Talk(quiet=quiet)
    with talk.progress("training", 1.0) as advance:
        shown = 0.0

        def report(progress: float, metrics: Metrics) -> None:
            nonlocal shown
            advance(progress - shown)
            shown = progress
            # On a terminal the bar moves instead; a log wants a line each time something was saved.
            if metrics.validation_deg is not None and (progress >= 1 or not sys.stderr.isatty()):
                talk.say(_line(metrics))

        trainer.run(report)
    if not quiet:
        print(output / WEIGHTS)


def _configure(output: Path, preset_name: str, seed: int, *, resume: bool) -> TrainingConfig:
    from splinecli.training.checkpoint import read_checkpoint_config
    from splinecli.training.config import preset
    from splinecli.training.loop import CHECKPOINT

    return read_checkpoint_config(output / CHECKPOINT) if resume else preset(preset_name, seed=seed)


def _line(metrics: Metrics) -> str:
    checked = "" if metrics.validation_deg is None else f", {metrics.validation_deg:.2f} deg on unseen pixels"
    return (
        f"step {metrics.step}, {metrics.pixels} pixels, {metrics.minutes:.1f} minutes: "
        f"loss {metrics.loss:.3f}, {metrics.angle_deg:.2f} deg{checked}"
    )
