"""Data-parallel training: the processes that torchrun starts, each on its shards of every batch.

Gradients are averaged after each backward pass, in one message, by gloo on processors and NCCL on GPUs. Every
process computes the same update of the same weights, so nothing else has to be exchanged but the leader's
clock.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from splinecli.errors import ModelError, UsageError


@dataclass(frozen=True)
class Workers:
    """This process among `count`; `rank` 0 leads: it alone writes, reports and keeps the time."""

    rank: int = 0
    count: int = 1

    @property
    def leads(self) -> bool:
        return self.rank == 0

    def shards(self, total: int) -> range:
        """The shards of a batch that are this process's. Raises UsageError where they cannot be shared out."""
        if total % self.count:
            raise UsageError(
                f"{self.count} processes cannot share the {total} shards of a batch evenly",
                hint=f"Give --param shards={self.count}, or start a number of processes that divides {total}",
            )
        return range(self.rank, total, self.count)

    def average(self, parameters: Iterable[nn.Parameter], numbers: Tensor) -> Tensor:
        """Average the parameters' gradients over the processes, in place, and `numbers` (N,), returned."""
        if self.count == 1:
            return numbers
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        message = torch.cat([*(gradient.flatten() for gradient in gradients), numbers.to(gradients[0])])
        with _losses_of_peers_named():
            dist.all_reduce(message)
        message /= self.count
        sizes = [*(gradient.numel() for gradient in gradients), len(numbers)]
        *averaged, numbers_averaged = torch.split(message, sizes)
        for gradient, mean in zip(gradients, averaged, strict=True):
            gradient.copy_(mean.view_as(gradient))
        return numbers_averaged.to(numbers)

    def agree(self, value: float, device: torch.device) -> float:
        """The leader's value."""
        if self.count == 1:
            return value
        shared = torch.tensor([value], dtype=torch.float64, device=device)
        with _losses_of_peers_named():
            dist.broadcast(shared, src=0)
        return float(shared.item())


@contextmanager
def _losses_of_peers_named() -> Iterator[None]:
    """Raise ModelError where the others cannot be reached any more."""
    try:
        yield
    except RuntimeError as error:
        reason = (str(error).splitlines() or ["no reason given"])[0][:200]
        raise ModelError(
            f"another process of the run stopped ({reason})",
            hint="Its own message says why; --resume goes on",
        ) from error


def is_launched() -> bool:
    """Whether torchrun started this process."""
    return "TORCHELASTIC_RUN_ID" in os.environ or int(os.environ.get("WORLD_SIZE", "1")) > 1


def is_to_go_on() -> bool:
    """Whether torchrun was told to start processes again when one fails: they then go on with the run.

    Not whether it just did so: after the failure of another machine's process it does not say so to this one's.
    """
    return int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")) > 0


def join_workers(device: torch.device) -> tuple[Workers, torch.device]:
    """Join the other processes, if torchrun started any; the device then is this process's own."""
    if not is_launched():
        return Workers(), device
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    if not dist.is_initialized():
        backend = "nccl" if device.type == "cuda" else "gloo"
        attempt = int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
        if attempt and os.environ.get("LOCAL_WORLD_SIZE") == os.environ.get("WORLD_SIZE"):
            # torchrun keeps its store over a restart: the addresses of processes that are gone still stand in
            # it. Only on one machine do all processes agree on the number of the attempt.
            store, rank, count = next(rendezvous("env://"))
            store = PrefixStore(f"splinecli attempt {attempt}", store)
            dist.init_process_group(backend, store=store, rank=rank, world_size=count)
        else:
            dist.init_process_group(backend)
    return Workers(dist.get_rank(), dist.get_world_size()), device


def leave_workers() -> None:
    """Leave the group, if one was joined."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()
