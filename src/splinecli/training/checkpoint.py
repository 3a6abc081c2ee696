"""Checkpoints: one safetensors file that rebuilds a run exactly where it stood.

There is no state of a random generator in it: what a step draws follows from the seed and the step's number.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from splinecli.errors import ModelError
from splinecli.files import write_bytes
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import load_strictly, read_json_entry, read_tensors, tensors_sha256
from splinecli.training.config import TrainingConfig

FORMAT = "splinecli-checkpoint-2"


@dataclass
class Clock:
    """How far a run has come."""

    step: int = 0
    pixels: int = 0
    seconds: float = 0.0


def save_checkpoint(
    path: Path,
    config: TrainingConfig,
    network: SplineNet,
    average: SplineNet,
    optimizer: torch.optim.Optimizer,
    clock: Clock,
    sets: dict[str, str],
) -> None:
    """Write the whole state of a run; `sets` are the SHA-256 of its pixel sets. Raises OutputError."""
    tensors: dict[str, Tensor] = {}
    for prefix, module in (("network", network), ("average", average)):
        tensors |= {f"{prefix}.{name}": tensor for name, tensor in module.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
    plain = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, tensor in tensors.items()
    }
    metadata = {
        "format": FORMAT,
        "config": json.dumps(config.to_dict()),
        "clock": json.dumps(asdict(clock)),
        "sets": json.dumps(sets),
        "tensors_sha256": tensors_sha256(plain),
    }
    write_bytes(path, save(plain, metadata))


def read_checkpoint_config(path: Path) -> TrainingConfig:
    """The configuration of the run behind a checkpoint. Raises ModelError."""
    _, metadata = _read(path)
    return TrainingConfig.from_dict(read_json_entry(metadata, "config", path))


def load_checkpoint(
    path: Path,
    network: SplineNet,
    average: SplineNet,
    optimizer: torch.optim.Optimizer,
    sets: dict[str, str],
) -> Clock:
    """Put a run's state back. Raises ModelError where the file, or one of the pixel sets, is not the run's."""
    tensors, metadata = _read(path)
    for name, sha256 in read_json_entry(metadata, "sets", path).items():
        if sets.get(name) != sha256:
            raise ModelError(
                f"the pixel set {name} is not what it was when the run was begun",
                path=path,
                hint="Put it back as it was, or choose another -o and begin anew",
            )
    groups: dict[str, dict[str, Tensor]] = {"network": {}, "average": {}, "optimizer": {}}
    for name, tensor in tensors.items():
        prefix, _, rest = name.partition(".")
        if prefix in groups:
            groups[prefix][rest] = tensor
    load_strictly(network, groups["network"], path)
    load_strictly(average, groups["average"], path)
    states: dict[int, dict[str, Tensor]] = {}
    for name, tensor in groups["optimizer"].items():
        index, _, key = name.partition(".")
        states.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})
    try:
        return Clock(**read_json_entry(metadata, "clock", path))
    except TypeError as error:
        raise ModelError(f"the checkpoint is incomplete ({error})", path=path) from error


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    hint = "A run begins without --resume; where this file is damaged, remove it or choose another -o"
    return read_tensors(path, FORMAT, hint)
