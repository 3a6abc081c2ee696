"""Data-parallel training: torchrun starts several processes, and each trains on its shards of every batch.

After each backward pass the processes average their gradients in one message, with gloo on CPUs and NCCL on GPUs.
Every process then computes the same update of the same weights. The only other data exchanged is the training time of
the first process.
"""

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
    """The rank of this process among `count` processes. Rank 0 leads: only it writes files and keeps the time."""

    rank: int = 0
    count: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process is the leader."""
        return self.rank == 0

    def shards(self, total: int) -> range:
        """Return the shards of a batch for this process. Raises UsageError if they cannot be shared evenly."""
        if total % self.count:
            raise UsageError(
                f"{self.count} processes cannot share the {total} shards of a batch evenly",
                hint=f"Add --param shards={self.count}, or start a number of processes that divides {total}",
            )
        return range(self.rank, total, self.count)

    def average(self, parameters: Iterable[nn.Parameter], numbers: Tensor) -> Tensor:
        """Average the gradients over all processes, in place, and return the average of `numbers` (N,)."""
        if self.count == 1:
            return numbers
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        message = torch.cat([*(gradient.flatten() for gradient in gradients), numbers.to(gradients[0])])
        with _lost_peers_as_model_errors():
            dist.all_reduce(message)
        message /= self.count
        sizes = [*(gradient.numel() for gradient in gradients), len(numbers)]
        *averaged, numbers_averaged = torch.split(message, sizes)
        for gradient, mean in zip(gradients, averaged, strict=True):
            gradient.copy_(mean.view_as(gradient))
        return numbers_averaged.to(numbers)

    def agree(self, value: float, device: torch.device) -> float:
        """Return the value of the first process, for all processes."""
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

    There is no way to know whether this has just happened: torchrun does not report failures on other machines.
    """
    return int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")) > 0


def join_workers(device: torch.device) -> tuple[Workers, torch.device]:
    """Join the other processes, if torchrun started any; return the rank of this process and its device."""
    if "TORCHELASTIC_RUN_ID" not in os.environ and int(os.environ.get("WORLD_SIZE", "1")) <= 1:
        return Workers(), device
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    if not dist.is_initialized():
        backend = "nccl" if device.type == "cuda" else "gloo"
        attempt = int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
        if attempt and os.environ.get("LOCAL_WORLD_SIZE") == os.environ.get("WORLD_SIZE"):
            # torchrun keeps its store after a restart, with the addresses of processes that have ended. Prefixing the
            # keys with the attempt number hides these. All processes agree on the number only on a single machine.
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
