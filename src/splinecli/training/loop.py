"""The training loop: LI-Net and NE-Net together, on pixels that the generator makes as they are needed.

The alternating updates and the special losses of the paper join here.
"""

from __future__ import annotations

import copy
import csv
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from splinecli.devices import choose_precision
from splinecli.errors import ModelError, OutputError
from splinecli.files import check_writable, write_text
from splinecli.networks.spline_net import SplineNet, to_pixel_frame
from splinecli.networks.weights import save_weights
from splinecli.observation_map import MAP_SIZE
from splinecli.synthesis.pixels import PixelBatch, PixelGenerator
from splinecli.training.checkpoint import Clock, load_checkpoint, save_checkpoint
from splinecli.training.config import TrainingConfig
from splinecli.training.losses import angular_loss, map_loss, masked_map_loss

CHECKPOINT = "checkpoint.safetensors"
WEIGHTS = "weights.safetensors"
METRICS = "metrics.csv"
VALIDATION_PIXELS = 2048
CHECKPOINT_SECONDS = 120.0
REPORT_STEPS = 50


@dataclass(frozen=True)
class Metrics:
    """One line of metrics.csv: means over the steps since the last line; angles in degrees."""

    step: int
    pixels: int
    minutes: float
    learning_rate: float
    loss: float
    angle_deg: float
    map_error: float
    validation_deg: float | None = None


def learning_rate(config: TrainingConfig, step: int, progress: float) -> float:
    """The rate at a step; progress in 0..1 is how much of the run is over. A pure function."""
    rise = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    if config.schedule == "stepped":
        return config.learning_rate * rise * (0.1 if progress >= 0.9 else 1.0)
    return config.learning_rate * rise * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))


class Trainer:
    """A run in a folder: `checkpoint.safetensors`, `weights.safetensors`, `config.json` and `metrics.csv`."""

    def __init__(
        self, config: TrainingConfig, folder: Path, device: torch.device, *, resume: bool = False
    ) -> None:
        """Start a run, or take one up. Raises ModelError, OutputError."""
        check_writable(folder)
        self.config = config
        self.folder = folder
        self.device = device
        torch.manual_seed(config.seed)
        self.network = SplineNet(config.network).to(device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=config.learning_rate,
            betas=(config.beta1, config.beta2),
            weight_decay=config.weight_decay,
        )
        self.generator = torch.Generator(device).manual_seed(config.seed)
        # Where it is emulated, bfloat16 is slower than float32 and gains nothing.
        self.bfloat16 = config.precision == "bfloat16" and choose_precision("auto", device) == "bfloat16"
        self.clock = Clock()
        if resume:
            self.clock = load_checkpoint(
                folder / CHECKPOINT, self.network, self.average, self.optimizer, self.generator
            )
            _drop_metrics_after(self.clock.step, folder / METRICS)
        elif (folder / CHECKPOINT).exists():
            raise OutputError(
                "holds a run already", path=folder, hint="Go on with --resume, or choose another -o"
            )
        else:
            # Of a run that ended before its first checkpoint.
            (folder / METRICS).unlink(missing_ok=True)
        write_text(folder / "config.json", json.dumps(config.to_dict(), indent=2) + "\n")
        self.pixels = PixelGenerator(config.pixels, self.generator)

    @property
    def progress(self) -> float:
        """How much of the run is over, 0 to 1."""
        if self.config.minutes > 0:
            return min(1.0, self.clock.seconds / (60 * self.config.minutes))
        return min(1.0, self.clock.step / self.config.steps)

    def run(self, report: Callable[[float, Metrics], None] | None = None) -> Metrics:
        """Train to the end; `report` is called with progress and metrics now and then. Saves as it goes.

        Raises ModelError when the loss is no longer finite.
        """
        validation = validation_set(self.config, self.device)
        sums, count = torch.zeros(3), 0
        saved = time.monotonic()
        started = saved - self.clock.seconds
        while True:
            finished = self.progress >= 1
            due = finished or time.monotonic() - saved > CHECKPOINT_SECONDS
            if (count == REPORT_STEPS or due) and count:
                checked_deg = (
                    validation_deg(self.average, validation, bfloat16=self.bfloat16) if due else None
                )
                metrics = self._metrics(sums / count, checked_deg)
                self._append(metrics)
                if due:
                    self.save()
                    saved = time.monotonic()
                if report:
                    report(self.progress, metrics)
                sums, count = torch.zeros(3), 0
                if finished:
                    return metrics
            elif finished:
                raise ModelError(
                    "the run is at its end already",
                    path=self.folder,
                    hint="Give it more --steps or --minutes",
                )
            sums += self.step()
            count += 1
            self.clock.seconds = time.monotonic() - started

    def step(self) -> Tensor:
        """One update of both networks on a fresh batch; returns loss, angle in degrees and map error."""
        config = self.config
        # Dropout draws from the global generator; seeded by the step, it is the same in a resumed run.
        torch.manual_seed((config.seed * 1_000_003 + self.clock.step) % 2**63)
        rate = learning_rate(config, self.clock.step, self.progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.network.train()
        batch = self.pixels.draw(config.batch_size)
        turn, mirror = self._jitter(len(batch.observations))
        views = self.network.look(
            batch.observations, batch.light_directions, batch.valid, turn_deg=turn, mirror=mirror
        )
        size = config.network.map_size
        dense_truth, normal_truth = truth_in_frame(
            batch, views.cosine, views.sine, views.scale, mirror, size=size
        )
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.bfloat16):
            dense = self.network.interpolate(views)
            normals = self.network.estimate(views, dense)
        angle = angular_loss(normals, normal_truth)
        on_map = map_loss(dense.float(), dense_truth, self.network.inside)
        masked = masked_map_loss(dense.float(), dense_truth, views.holds)
        loss = config.angle_weight * angle + config.map_weight * on_map + config.masked_weight * masked
        if not torch.isfinite(loss):
            raise ModelError(
                f"the loss is {loss.item()} at step {self.clock.step}", hint="Lower the learning rate"
            )
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_limit)
        self.optimizer.step()
        self._follow()
        self.clock.step += 1
        self.clock.pixels += config.batch_size
        return torch.stack((loss.detach(), torch.rad2deg(angle.detach()), on_map.detach())).cpu()

    def save(self) -> None:
        """Write the checkpoint and the averaged weights. Raises OutputError."""
        save_checkpoint(
            self.folder / CHECKPOINT,
            self.config,
            self.network,
            self.average,
            self.optimizer,
            self.generator,
            self.clock,
        )
        save_weights(self.average, self.folder / WEIGHTS)

    def _jitter(self, pixels: int) -> tuple[Tensor | float, bool]:
        if not self.network.config.is_canonical:
            return 0.0, False
        turn = 2 * torch.rand(pixels, generator=self.generator, device=self.device) - 1
        mirror = bool(torch.rand((), generator=self.generator, device=self.device) < 0.5)
        return turn * self.config.turn_jitter_deg, mirror

    def _follow(self) -> None:
        # A young average would remember the start for too long: its decay grows with the steps.
        decay = min(self.config.average_decay, (1 + self.clock.step) / (10 + self.clock.step))
        with torch.no_grad():
            pairs = zip(self.average.parameters(), self.network.parameters(), strict=True)
            for averaged, current in pairs:
                averaged.lerp_(current, 1 - decay)

    def _metrics(self, means: Tensor, checked_deg: float | None) -> Metrics:
        loss, angle_deg, map_error = means.tolist()
        return Metrics(
            step=self.clock.step,
            pixels=self.clock.pixels,
            minutes=round(self.clock.seconds / 60, 3),
            learning_rate=self.optimizer.param_groups[0]["lr"],
            loss=loss,
            angle_deg=angle_deg,
            map_error=map_error,
            validation_deg=checked_deg,
        )

    def _append(self, metrics: Metrics) -> None:
        path = self.folder / METRICS
        row = vars(metrics)
        try:
            fresh = not path.exists()
            with path.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, row.keys())
                if fresh:
                    writer.writeheader()
                writer.writerow({key: f"{x:.6g}" if isinstance(x, float) else x for key, x in row.items()})
        except OSError as error:
            raise OutputError(f"cannot be written ({error.strerror})", path=path) from error


def _drop_metrics_after(step: int, path: Path) -> None:
    # Lines come oftener than checkpoints: those after the last one are about to be written again.
    if path.exists():
        header, *lines = path.read_text("utf-8").splitlines() or [""]
        kept = [
            line for line in lines if line.partition(",")[0].isdigit() and int(line.partition(",")[0]) <= step
        ]
        write_text(path, "\n".join([header, *kept]) + "\n")


def truth_in_frame(
    batch: PixelBatch, cosine: Tensor, sine: Tensor, scale: Tensor, mirror: bool, *, size: int = MAP_SIZE
) -> tuple[Tensor, Tensor]:
    """In the pixels' frames: D_gt (P, 1, w, w), at the sparse map's scale, cut at 1; normals (P, 3)."""
    scene = batch.scene.rotate(cosine, sine)
    dense = (scene.dense_map(size) * (batch.exposure / scale)[..., None, None]).clamp(max=1)
    normals = scene.normals
    if mirror:
        # The cells' centres lie symmetrically, so mirroring y is turning the rows over.
        dense, normals = dense.flip(2), normals * normals.new_tensor((1.0, -1.0, 1.0))
    return dense, normals


def validation_set(config: TrainingConfig, device: torch.device) -> PixelBatch:
    """Pixels under `usual_lights` lights from a generator of their own: checking never disturbs training."""
    count = config.pixels.usual_lights
    fixed = replace(config.pixels, min_lights=count, max_lights=count)
    return PixelGenerator(fixed, torch.Generator(device).manual_seed(2**31 + config.seed)).draw(
        VALIDATION_PIXELS
    )


@torch.no_grad()
def validation_deg(network: SplineNet, batch: PixelBatch, *, bfloat16: bool = False) -> float:
    """Mean angular error in degrees."""
    network.eval()
    views = network.look(batch.observations, batch.light_directions, batch.valid)
    with torch.autocast(batch.observations.device.type, dtype=torch.bfloat16, enabled=bfloat16):
        normals = network.estimate(views, network.interpolate(views))
    return math.degrees(angular_loss(normals, to_pixel_frame(batch.scene.normals, views)).item())
