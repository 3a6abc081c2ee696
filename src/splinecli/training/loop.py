"""The training loop: batches in, updates of LI-Net and NE-Net together or in alternation, files out."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splinecli.devices import choose_precision
from splinecli.errors import ModelError, OutputError
from splinecli.files import check_writable, write_text
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import resolve_weights, save_weights
from splinecli.synthesis.batches import PixelBatch, join_batches
from splinecli.training.checkpoint import RunCounters, load_checkpoint, save_checkpoint
from splinecli.training.config import TrainingConfig
from splinecli.training.defaults import CHECKPOINT, CHECKPOINT_SECONDS, CONFIG, REPORT_STEPS, WEIGHTS
from splinecli.training.distributed import Workers
from splinecli.training.objective import Losses, Part, compute_losses, part_of_step
from splinecli.training.run_log import Metrics, RunLog, none_for_nan
from splinecli.training.sources import open_sources
from splinecli.training.validation import sample_maps, validation_deg

VALIDATION_PIXELS = 2048

# Random streams of a step, beside those of its shards, which are numbered from 0.
# The last is that of process 0; the others' follow it.
_BATCH_STREAM, _VALIDATION_STREAM, _DROPOUT_STREAM = 2**31, 2**31 + 1, 2**31 + 2


def learning_rate(config: TrainingConfig, step: int, progress: float) -> float:
    """The rate at a step; progress in 0..1 is how much of the run is over. A pure function."""
    rise = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    if config.schedule == "stepped":
        return config.learning_rate * rise * (0.1 if progress >= 0.9 else 1.0)
    return config.learning_rate * rise * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))


def stream_seed(seed: int, step: int, stream: int) -> int:
    """The seed of one of a step's random streams.

    What a step draws follows from these three numbers alone: not from what was drawn before, nor by whom. A
    run that is taken up, or cut among processes in another way, sees the same batches.
    """
    return int(np.random.SeedSequence((seed, step, stream)).generate_state(1, np.uint64)[0] >> 1)


def _start_from(weights: str, network: SplineNet) -> None:
    loaded = resolve_weights(weights).network
    wanted, found = network.config.to_dict(), loaded.config.to_dict()
    # A network may grow an error head, and loses the one it has where it is trained further.
    differing = [name for name in wanted if wanted[name] != found[name] and name != "error_head"]
    if differing:
        name = differing[0]
        raise ModelError(
            f"the weights {weights!r} are of a network with {name} = {found[name]!r}, the run's has {wanted[name]!r}",
            hint="Choose the preset, or the settings network.*, that the weights were trained with",
        )
    network.load_state_dict(loaded.state_dict(), strict=wanted["error_head"] == found["error_head"])


class Trainer:
    """A run in a folder: checkpoint, weights, config.json and the records.

    Of several processes the leader alone writes.
    """

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path,
        device: torch.device,
        *,
        resume: bool = False,
        workers: Workers | None = None,
        tensorboard: bool = False,
    ) -> None:
        """Start a run, or take one up. Raises ModelError, OutputError, InputError, UsageError."""
        check_writable(folder)
        self.config = config
        self.folder = folder
        self.device = device
        self.workers = workers or Workers()
        self.shards = self.workers.shards(config.shards)
        self.generator = torch.Generator(device)
        validation_generator = torch.Generator(device)
        validation_generator.manual_seed(stream_seed(config.seed, 0, _VALIDATION_STREAM))
        if not resume and (folder / CHECKPOINT).exists():
            raise OutputError(
                "holds a run already", path=folder, hint="Go on with --resume, or choose another -o"
            )
        sources = open_sources(config, self.generator, validation_generator)
        self.source = sources.training
        self.sets, self.single_scene_sets = sources.sets, sources.single_scene_sets
        torch.manual_seed(config.seed)
        self.network = SplineNet(config.network).to(device)
        if config.start_from and not resume:
            _start_from(config.start_from, self.network)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=config.learning_rate,
            betas=(config.beta1, config.beta2),
            weight_decay=config.weight_decay,
        )
        # Where it is emulated, bfloat16 is slower than float32 and gains nothing.
        self.bfloat16 = config.precision == "bfloat16" and choose_precision("auto", device) == "bfloat16"
        self.counters = RunCounters()
        if resume:
            self.counters = load_checkpoint(
                folder / CHECKPOINT, self.network, self.average, self.optimizer, self.sets
            )
        if self.workers.leads:
            self.log = RunLog(folder, self.counters.step, tensorboard=tensorboard)
            self.validation = sources.validation.draw(VALIDATION_PIXELS)
            write_text(folder / CONFIG, json.dumps(config.to_dict(), indent=2) + "\n")

    @property
    def progress(self) -> float:
        """How much of the run is over, 0 to 1."""
        if self.config.minutes > 0:
            return min(1.0, self.counters.seconds / (60 * self.config.minutes))
        return min(1.0, self.counters.step / self.config.steps)

    def run(self, report: Callable[[float, Metrics], None] | None = None) -> Metrics | None:
        """Train to the end and save on the way; `report` is called with progress and metrics now and then.

        Returns the last metrics, on the leader.

        Raises:
            ModelError: the loss or its gradient is no longer finite, or the run is at its end already; the
                last checkpoint stays.
            OutputError: a file cannot be written.
        """
        if self.progress >= 1:
            raise ModelError(
                "the run is at its end already", path=self.folder, hint="Give it more --steps or --minutes"
            )
        metrics = None
        losses: dict[Part, list[Tensor]] = {}
        count = 0
        saved = time.monotonic()
        started = saved - self.counters.seconds
        while self.progress < 1:
            part = part_of_step(self.config, self.counters.step)
            losses.setdefault(part, []).append(self.step())
            count += 1
            self.counters.seconds = self.workers.agree(time.monotonic() - started, self.device)
            due = self.progress >= 1 or time.monotonic() - saved > CHECKPOINT_SECONDS
            if not (due or count >= REPORT_STEPS):
                continue
            if self.workers.leads:
                if due:
                    self._check_weights()
                means = [torch.stack(steps).mean(dim=0) for steps in losses.values()]
                metrics = self._metrics(torch.stack(means), check=due)
                self.log.append(metrics)
                if due:
                    self.save()
                    saved = time.monotonic()
                if report:
                    report(self.progress, metrics)
            losses, count = {}, 0
        return metrics

    def draw(self) -> tuple[PixelBatch, Tensor, bool]:
        """This process's part of the step's batch, the pixels' further turns in degrees, whether mirrored."""
        canonical = self.network.config.is_canonical
        self.generator.manual_seed(stream_seed(self.config.seed, self.counters.step, _BATCH_STREAM))
        mirrored = canonical and bool(torch.rand((), generator=self.generator, device=self.device) < 0.5)
        pixels = self.config.batch_size // self.config.shards
        batches, turns = [], []
        for shard in self.shards:
            self.generator.manual_seed(stream_seed(self.config.seed, self.counters.step, shard))
            batches.append(self.source.draw(pixels))
            turns.append(2 * torch.rand(pixels, generator=self.generator, device=self.device) - 1)
        jitter_deg = self.config.turn_jitter_deg if canonical else 0.0
        return join_batches(batches), torch.cat(turns) * jitter_deg, mirrored

    def step(self) -> Tensor:
        """One update on a fresh batch; returns the losses (6,), as in Losses, averaged over all processes."""
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(config, self.counters.step, self.progress)
        batch, turn_deg, mirrored = self.draw()
        # Dropout draws from the global generator; seeded by the step, it is the same in a resumed run.
        torch.manual_seed(stream_seed(config.seed, self.counters.step, _DROPOUT_STREAM + self.workers.rank))
        self.network.train()
        self.optimizer.zero_grad(set_to_none=True)
        losses = compute_losses(
            self.network,
            batch,
            config,
            part=part_of_step(config, self.counters.step),
            turn_deg=turn_deg,
            mirrored=mirrored,
            bfloat16=self.bfloat16,
        )
        torch.autograd.backward(losses.total)
        numbers = self.workers.average(
            self.network.parameters(), torch.stack([loss.detach().double() for loss in losses])
        ).cpu()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_limit or math.inf)
        for name, value in (("loss", numbers[0]), ("gradient", norm)):
            if not torch.isfinite(value):
                raise self._not_finite(f"the {name} is {value.item()}")
        self.optimizer.step()
        self._follow()
        self.counters.step += 1
        self.counters.pixels += config.batch_size
        return numbers

    def save(self) -> None:
        """Write checkpoint, averaged weights and pictures. Raises OutputError."""
        save_checkpoint(
            self.folder / CHECKPOINT,
            self.config,
            self.network,
            self.average,
            self.optimizer,
            self.counters,
            self.sets,
        )
        save_weights(self.average, self.folder / WEIGHTS)
        self.log.draw(sample_maps(self.average, self.validation))

    def _check_weights(self) -> None:
        """Raise ModelError before anything that is not finite is saved."""
        for name, tensor in self.network.state_dict().items():
            if not torch.isfinite(tensor).all():
                raise self._not_finite(f"the tensor {name} is no longer finite")

    def _not_finite(self, problem: str) -> ModelError:
        lower = "a lower rate, such as --param learning_rate=1e-4"
        hint = f"Begin anew with {lower}"
        if (self.folder / CHECKPOINT).exists():
            hint = f"The last checkpoint is kept: --resume goes on from it with {lower}"
        return ModelError(f"{problem} at step {self.counters.step}", path=self.folder, hint=hint)

    def _follow(self) -> None:
        # A young average would remember the start for too long: its decay grows with the steps.
        decay = min(self.config.average_decay, (1 + self.counters.step) / (10 + self.counters.step))
        with torch.no_grad():
            pairs = zip(self.average.parameters(), self.network.parameters(), strict=True)
            for averaged, current in pairs:
                averaged.lerp_(current, 1 - decay)

    def _metrics(self, means: Tensor, *, check: bool) -> Metrics:
        """From the means (N, 6) over the steps of each part: of "both", or of NE-Net and LI-Net."""
        # Each network has a loss of its own, and those are added up; the errors are of one kind.
        summed, averaged = Losses(*means.sum(dim=0).tolist()), Losses(*means.mean(dim=0).tolist())
        checked_deg = validation_deg(self.average, self.validation, bfloat16=self.bfloat16) if check else None
        return Metrics(
            step=self.counters.step,
            pixels=self.counters.pixels,
            minutes=round(self.counters.seconds / 60, 3),
            learning_rate=self.optimizer.param_groups[0]["lr"],
            loss=float(summed.total),
            angle_deg=math.degrees(averaged.angle),
            map_error=none_for_nan(float(averaged.on_map)),
            masked_map_error=none_for_nan(float(averaged.masked)),
            symmetric=none_for_nan(float(summed.symmetric)),
            asymmetric=none_for_nan(float(summed.asymmetric)),
            validation_deg=checked_deg,
        )
