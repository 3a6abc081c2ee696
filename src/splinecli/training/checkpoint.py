"""Checkpoints: one safetensors file from which a run continues where it stopped.

A checkpoint contains no state of a random generator. The draws of a step follow from the seed and the step number
alone. A run of the refinement net photographs its newest captures again, and goes on without the earlier ones.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from splinecli.errors import ModelError
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import load_strictly, read_json_entry, read_tensors, serialise, tensors_sha256
from splinecli.system.files import write_bytes
from splinecli.training.config import TrainingConfig

FORMAT = "splinecli-checkpoint-2"
_COUNTERS_KEY = "clock"  # the name of this entry in checkpoints of every version so far


@dataclass
class RunCounters:
    """Steps, training pixels and seconds of training so far."""

    step: int = 0
    pixels: int = 0
    seconds: float = 0.0


def save_checkpoint(
    path: Path,
    config: TrainingConfig,
    network: SplineNet,
    average: SplineNet,
    optimizer: torch.optim.Optimizer,
    counters: RunCounters,
    sets: dict[str, str],
) -> None:
    """Write the whole state of a run: the network with its running average, and the SHA-256 of each pixel set by path.

    Raises OutputError.
    """
    tensors: dict[str, Tensor] = {}
    for prefix, module in (("network", network), ("average", average)):
        tensors |= {f"{prefix}.{name}": tensor for name, tensor in module.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
    plain = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()
    }
    metadata = {
        "format": FORMAT,
        "config": json.dumps(config.to_dict()),
        _COUNTERS_KEY: json.dumps(asdict(counters)),
        "sets": json.dumps(sets),
        "tensors_sha256": tensors_sha256(plain),
    }
    write_bytes(path, serialise(plain, metadata))


def read_checkpoint_config(path: Path) -> TrainingConfig:
    """Read the configuration of the run that wrote a checkpoint. Raises ModelError."""
    _, metadata = _read(path)
    return TrainingConfig.from_dict(read_json_entry(metadata, "config", path))


def load_checkpoint(
    path: Path, network: SplineNet, average: SplineNet, optimizer: torch.optim.Optimizer, sets: dict[str, str]
) -> RunCounters:
    """Restore networks and optimiser from a checkpoint, in place, and return the counters of the run.

    Raises ModelError if the file is missing, damaged or from another network, or a pixel set has changed.
    """
    tensors, metadata = _read(path)
    for name, sha256 in read_json_entry(metadata, "sets", path).items():
        if sets.get(name) != sha256:
            raise ModelError(
                f"the pixel set {name} has changed since the run was started",
                path=path,
                hint="Restore the pixel set, or start another run with another -o",
            )
    load_strictly(network, _under("network.", tensors), path)
    load_strictly(average, _under("average.", tensors), path)
    states: dict[int, dict[str, Tensor]] = {}
    try:
        for name, tensor in _under("optimizer.", tensors).items():
            index, _, key = name.partition(".")
            states.setdefault(int(index), {})[key] = tensor
        optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})
        counters = RunCounters(**read_json_entry(metadata, _COUNTERS_KEY, path))
        return RunCounters(int(counters.step), int(counters.pixels), float(counters.seconds))
    except (TypeError, ValueError, KeyError) as error:
        raise ModelError(f"the checkpoint is incomplete ({error})", path=path) from error


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    hint = "Start a run without --resume. If this file is damaged, remove it or choose another -o"
    return read_tensors(path, FORMAT, hint)
