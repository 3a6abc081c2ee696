"""The training loop, which draws batches, updates LI-Net and NE-Net together or in turn, and saves
the run.

A run starts or continues in a folder, with one process or with all processes of torchrun. After
each backward pass, the processes average their gradients in one message, with gloo on CPUs and NCCL
on GPUs. Every process then computes the same update of the same weights. The only other data
exchanged is the training time of the first process.
"""

import copy
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from splinecli.errors import ModelError, OutputError, UsageError
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import resolve_weights
from splinecli.system.files import check_writable, write_text
from splinecli.system.machine import choose_device, choose_precision, use_available_cores
from splinecli.system.progress import SILENT, Observer
from splinecli.system.publishing import held_folder
from splinecli.workshop.save_weights import save_weights
from splinecli.workshop.synthesis import stream_seed
from splinecli.workshop.training import (
    CHECKPOINT,
    CHECKPOINT_SECONDS,
    CONFIG,
    REPORT_STEPS,
    WEIGHTS,
    run_files,
)
from splinecli.workshop.training.config import Settings, TrainingConfig, check_resumable, configure
from splinecli.workshop.training.objective import Losses, Part, part_of_step
from splinecli.workshop.training.run_files import Metrics, RunCounters, RunLog
from splinecli.workshop.training.tasks import DROPOUT_STREAM, PixelTask, RefinementTask


@dataclass(frozen=True)
class Workers:
    """The rank of this process among `count` processes. The process of rank 0 is the leader.

    Only the leader keeps the time, and writes files other than captures.
    """

    rank: int = 0
    count: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process is the leader."""
        return self.rank == 0

    def shards(self, total: int) -> range:
        """Return the shards of a batch for this process.

        Raises UsageError if they cannot be shared evenly.
        """
        if total % self.count:
            raise UsageError(
                f"{self.count} processes cannot share the {total} shards of a batch evenly",
                hint=(
                    f"Add --param shards={self.count}, or start a number of processes that divides"
                    f" {total}"
                ),
            )
        return range(self.rank, total, self.count)

    def average(self, parameters: Iterable[nn.Parameter], numbers: Tensor) -> Tensor:
        """Average the gradients over all processes, in place, and return the average of `numbers`
        (N,).
        """
        if self.count == 1:
            return numbers
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        message = torch.cat(
            [*(gradient.flatten() for gradient in gradients), numbers.to(gradients[0])]
        )
        with _lost_peers_as_model_errors():
            dist.all_reduce(message)
        message /= self.count
        sizes = [*(gradient.numel() for gradient in gradients), len(numbers)]
        *averaged, numbers_averaged = torch.split(message, sizes)
        for gradient, mean in zip(gradients, averaged, strict=True):
            gradient.copy_(mean.view_as(gradient))
        return numbers_averaged.to(numbers)

    def agree(self, value: float, device: torch.device) -> float:
        """Return the value of the first process in all processes."""
        if self.count == 1:
            return value
        shared = torch.tensor([value], dtype=torch.float64, device=device)
        with _lost_peers_as_model_errors():
            dist.broadcast(shared, src=0)
        return float(shared.item())


@contextmanager
def _lost_peers_as_model_errors() -> Iterator[None]:
    """Raise ModelError if another process can no longer be reached."""
    try:
        yield
    except RuntimeError as error:
        reason = (str(error).splitlines() or ["no reason given"])[0][:200]
        raise ModelError(
            f"another process of the run stopped ({reason})",
            hint="See its own message for the reason. --resume continues the run",
        ) from error


def restarts_are_allowed() -> bool:
    """Return whether torchrun restarts the processes when one fails. They then continue the run.

    There is no way to know whether this has just happened: torchrun does not report failures on
    other machines.
    """
    return int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")) > 0


def join_workers(device: torch.device) -> tuple[Workers, torch.device]:
    """Join the other processes if torchrun started any, and return the rank and device of this
    process.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ and int(os.environ.get("WORLD_SIZE", "1")) <= 1:
        return Workers(), device
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    if not dist.is_initialized():
        backend = "nccl" if device.type == "cuda" else "gloo"
        attempt = int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
        if attempt and os.environ.get("LOCAL_WORLD_SIZE") == os.environ.get("WORLD_SIZE"):
            # torchrun keeps its store after a restart, with the addresses of processes that have
            # ended. Prefixing the keys with the attempt number hides these. All processes agree on
            # the number only on a single machine.
            store, rank, count = next(rendezvous("env://"))
            store = PrefixStore(f"splinecli attempt {attempt}", store)
            dist.init_process_group(backend, store=store, rank=rank, world_size=count)
        else:
            dist.init_process_group(backend)
    return Workers(dist.get_rank(), dist.get_world_size()), device


def leave_workers() -> None:
    """Leave the process group, if this process joined one."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def learning_rate(config: TrainingConfig, step: int, progress: float) -> float:
    """Return the learning rate at a step. Progress, in 0..1, is the finished share of the run."""
    rise = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    if config.schedule == "stepped":
        return config.learning_rate * rise * (0.1 if progress >= 0.9 else 1.0)
    return (
        config.learning_rate
        * rise
        * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))
    )


def _start_from(weights: str, network: SplineNet) -> None:
    """Copy weights into the network, which may also have an error head, refinement nets or
    context, or leave the first two out.
    """
    loaded = resolve_weights(weights).network
    wanted, found = network.config.to_dict(), loaded.config.to_dict()
    free = {"error_head", "refines"} | {n for n in ("sees_capture", "refines_twice") if wanted[n]}
    if not wanted["refines"]:
        free.add("refines_twice")
    for name in wanted:
        if wanted[name] != found[name] and name not in free:
            problem = f"with {name} = {found[name]!r}, the run's has {wanted[name]!r}"
            raise ModelError(
                f"the weights {weights!r} are of a network {problem}",
                hint=(
                    "Choose the preset, or the settings network.*, that the weights were trained"
                    " with"
                ),
            )
    if wanted["refines_twice"] and not found["refines"]:
        raise ModelError(
            f"the weights {weights!r} have no refinement net, and the run would train the second"
            " one",
            hint="Train the first one with --param network.refines_twice=false",
        )
    network.load_state_dict(loaded.state_dict(), strict=False)


class Trainer:
    """A run and its folder: checkpoint, weights, config.json, log and pictures.

    With several processes, only the leader writes files other than captures.
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
        observer: Observer = SILENT,
    ) -> None:
        """Start a run, or resume one; see open_run. Raises ModelError, OutputError, InputError,
        UsageError.
        """
        self.config = config
        self.folder = folder
        self.device = device
        self.workers = workers or Workers()
        self.shards = self.workers.shards(config.shards)
        if not resume and (folder / CHECKPOINT).exists():
            raise OutputError(
                "already contains a run",
                path=folder,
                hint="Continue it with --resume, or choose another -o",
            )
        task = RefinementTask if config.updates == "refine_net" else PixelTask
        self.task: PixelTask | RefinementTask = task(config, self.shards, device)
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
        # Emulated bfloat16 is slower than float32.
        self.bfloat16 = (
            config.precision == "bfloat16" and choose_precision("auto", device) == "bfloat16"
        )
        self.counters = RunCounters()
        if resume:
            state = self.network, self.average, self.optimizer
            self.counters = run_files.load_checkpoint(
                folder / CHECKPOINT, *state, self.task.sets.sha256
            )
        if self.workers.leads and self.task.long_start:
            observer.say(self.task.long_start)
        self.task.prepare(self.network, folder, rank=self.workers.rank, step=self.counters.step)
        if self.workers.leads:
            self.log = RunLog(folder, self.counters.step, tensorboard=tensorboard)
            write_text(folder / CONFIG, json.dumps(config.to_dict(), indent=2) + "\n")

    @property
    def progress(self) -> float:
        """The finished share of the run, 0 to 1."""
        if self.config.minutes > 0:
            return min(1.0, self.counters.seconds / (60 * self.config.minutes))
        return min(1.0, self.counters.step / self.config.steps)

    def run(self, report: Callable[[float, Metrics], None] | None = None) -> Metrics | None:
        """Train to the end, saving regularly, and return the last metrics on the leader.

        A finished run is not changed. `report` is called with progress and metrics at each entry of
        the log. Raises ModelError if the loss or its gradient is no longer finite, in which case
        the last checkpoint remains. Raises OutputError if a file cannot be written.
        """
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
                if due:  # before the weights are saved
                    for name, tensor in self.network.state_dict().items():
                        if not torch.isfinite(tensor).all():
                            raise self._not_finite(f"the tensor {name} is no longer finite")
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

    def step(self) -> Tensor:
        """Update once on a new batch, and return the losses (6,), as in Losses, averaged over all
        processes.
        """
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(config, self.counters.step, self.progress)
        # Dropout draws from the global generator. It is seeded by the step, so a resumed run drops
        # the same channels.
        torch.manual_seed(
            stream_seed(config.seed, self.counters.step, DROPOUT_STREAM + self.workers.rank)
        )
        self.network.train()
        self.optimizer.zero_grad(set_to_none=True)
        total = torch.zeros(len(Losses._fields), dtype=torch.float64, device=self.device)
        for losses in self.task.losses(self.network, self.counters.step, bfloat16=self.bfloat16):
            torch.autograd.backward(losses.total / len(self.shards))
            total += torch.stack([loss.detach().double() for loss in losses]) / len(self.shards)
        numbers = self.workers.average(self.network.parameters(), total).cpu()
        norm = torch.nn.utils.clip_grad_norm_(
            self.network.parameters(), config.gradient_limit or math.inf
        )
        for name, value in (("loss", numbers[0]), ("gradient", norm)):
            if not torch.isfinite(value):
                raise self._not_finite(f"the {name} is {value.item()}")
        self.optimizer.step()
        # Increase the decay with the steps; otherwise the average would depend on the initial
        # weights for too long.
        decay = min(config.average_decay, (1 + self.counters.step) / (10 + self.counters.step))
        with torch.no_grad():
            for averaged, current in zip(
                self.average.parameters(), self.network.parameters(), strict=True
            ):
                averaged.lerp_(current, 1 - decay)
        self.counters.step += 1
        self.counters.pixels += config.batch_size
        return numbers

    def save(self) -> None:
        """Write averaged weights, pictures and the checkpoint. Raises OutputError.

        The checkpoint comes last, so a run that is killed before that repeats the steps and
        rewrites the other files.
        """
        save_weights(self.average, self.folder / WEIGHTS)
        self.log.draw(self.task.sample_maps(self.average))
        state = self.network, self.average, self.optimizer, self.counters
        run_files.save_checkpoint(
            self.folder / CHECKPOINT, self.config, *state, self.task.sets.sha256
        )

    def _not_finite(self, problem: str) -> ModelError:
        lower = "a lower learning rate, such as --param learning_rate=1e-4"
        hint = f"Start again with {lower}"
        if (self.folder / CHECKPOINT).exists():
            hint = f"The last checkpoint is kept. Use --resume with {lower}"
        return ModelError(f"{problem} at step {self.counters.step}", path=self.folder, hint=hint)

    def _metrics(self, means: Tensor, *, check: bool) -> Metrics:
        """Return the metrics from means (N, 6) over the steps of each part: both together, or
        NE-Net and LI-Net.
        """
        # Each network has its own loss, so losses are added. Errors are averaged.
        summed, averaged = Losses(*means.sum(dim=0).tolist()), Losses(*means.mean(dim=0).tolist())
        checked_deg = (
            self.task.validation_deg(self.average, bfloat16=self.bfloat16) if check else None
        )
        return Metrics(
            step=self.counters.step,
            pixels=self.counters.pixels,
            minutes=round(self.counters.seconds / 60, 3),
            learning_rate=self.optimizer.param_groups[0]["lr"],
            loss=float(summed.total),
            angle_deg=math.degrees(averaged.angle),
            map_error=run_files.none_for_nan(float(averaged.on_map)),
            masked_map_error=run_files.none_for_nan(float(averaged.masked)),
            symmetric=run_files.none_for_nan(float(summed.symmetric)),
            asymmetric=run_files.none_for_nan(float(summed.asymmetric)),
            validation_deg=checked_deg,
        )


def configure_run(
    folder: Path,
    preset_name: str | None,
    file: Path | None,
    changes: Sequence[Settings],
    *,
    resume: bool,
) -> tuple[TrainingConfig, bool]:
    """Return the configuration of a run, and whether it continues an earlier one.

    A run continues on request, or after torchrun has restarted its processes, so that with
    --max-restarts, one command both starts a run and continues it. Without a preset, settings that
    are not given keep the values of the continued run. Raises ModelError or UsageError.
    """
    if not (resume or (restarts_are_allowed() and (folder / CHECKPOINT).exists())):
        return configure(preset_name, file, changes), False
    started = run_files.read_checkpoint_config(folder / CHECKPOINT)
    asked = configure(preset_name, file, changes, base=started)
    check_resumable(started, asked, folder / CHECKPOINT)
    return asked, True


@contextmanager
def open_run(
    config: TrainingConfig,
    folder: Path,
    device_name: str,
    *,
    resume: bool,
    tensorboard: bool,
    observer: Observer,
) -> Iterator[Trainer]:
    """Join the other processes, lock the folder and yield the trainer of a configured run.

    The configuration is from `configure_run`. The observer receives messages about files left by a
    killed process and about a slow start. Raises UsageError if the processes cannot share a batch,
    the device is not available, or TensorBoard is not installed; ModelError if the checkpoint does
    not fit, or the initial weights cannot be used; InputError if a pixel set cannot be used;
    OutputError if the folder cannot be written, or contains a run and `resume` is not set.
    """
    check_writable(folder)
    use_available_cores()
    workers, device = join_workers(choose_device(device_name))
    with ExitStack() as stack:
        stack.callback(leave_workers)
        workers.shards(config.shards)  # raises UsageError before the folder is made
        if workers.leads:
            stack.enter_context(held_folder(folder, observer.warn))
        workers.agree(0.0, device)  # the others wait until the folder is locked
        yield Trainer(
            config,
            folder,
            device,
            resume=resume,
            workers=workers,
            tensorboard=tensorboard,
            observer=observer,
        )
