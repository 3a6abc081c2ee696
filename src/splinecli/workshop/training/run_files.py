"""The files of a run: its log (metrics.csv, curves.png, maps.png, TensorBoard's event files) and
its checkpoints.

A checkpoint is one safetensors file from which a run continues where it stopped. It does not
contain the state of random generators, because the draws of a step depend only on the seed and the
number of the step.
"""

import csv
import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from msgspec import Struct, to_builtins
from torch import Tensor

from splinecli.errors import ModelError, OutputError
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.pictures.plots import observation_map_figure, png_bytes, training_figure
from splinecli.records.output_files import CURVES, TRAINING_MAPS
from splinecli.system.files import free_name, refusals_as_output_errors, write_bytes, write_text
from splinecli.system.machine import import_extra
from splinecli.system.publishing import refuse_link
from splinecli.system.weight_files import (
    load_strictly,
    read_json_entry,
    read_tensors,
    tensors_sha256,
)
from splinecli.workshop.save_weights import serialise
from splinecli.workshop.training import EVENTS, METRICS
from splinecli.workshop.training.config import TrainingConfig
from splinecli.workshop.training.tasks import SampleMaps


@dataclass(frozen=True)
class Metrics:
    """A line of metrics.csv: means over the steps since the previous line. None if a value was not
    computed.
    """

    step: int  # number of updates so far
    pixels: int  # number of training pixels so far (captures for a refinement net)
    minutes: float  # training time so far
    learning_rate: float  # the rate of the last update
    # the weighted sum of all terms. If LI-Net and NE-Net are updated in turn, the sum of both
    # losses.
    loss: float
    angle_deg: float  # mean angular error of the training pixels, in degrees
    map_error: float | None  # mean absolute error of LI-Net's dense map. None without a LI-Net.
    masked_map_error: float | None  # the same over the cells of the sparse map
    # symmetric, asymmetric: Ls and La, unweighted. None if their weights are 0.
    symmetric: float | None = None
    asymmetric: float | None = None
    # mean angular error of the validation pixels, in degrees. None between checkpoints.
    validation_deg: float | None = None


_HEADER = ",".join(field.name for field in fields(Metrics))


class RunLog:
    """Writes the log files in `folder`. Its methods raise OutputError if a file cannot be
    written.
    """

    def __init__(self, folder: Path, step: int, *, tensorboard: bool = False) -> None:
        """Open the log at a step and drop the lines of later steps, which the run will repeat.

        Raises UsageError if `tensorboard` is set and the package is not installed.
        """
        self.folder = folder
        self.set_aside = _drop_lines_after(step, folder / METRICS)
        self._events: Any = None
        if tensorboard:
            refuse_link(folder / EVENTS)
            writer = import_extra("torch.utils.tensorboard", "tensorboard").SummaryWriter
            with refusals_as_output_errors(folder / EVENTS):
                self._events = writer(str(folder / EVENTS), purge_step=step + 1)

    def append(self, metrics: Metrics) -> None:
        """Add a line to metrics.csv and to TensorBoard's event file."""
        path, row = self.folder / METRICS, vars(metrics)
        try:
            is_new = not path.exists()
            with path.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, row.keys(), lineterminator="\n")
                if is_new:
                    writer.writeheader()
                writer.writerow(
                    {key: f"{x:.6g}" if isinstance(x, float) else x for key, x in row.items()}
                )
        except OSError as error:
            raise OutputError(f"cannot be written ({error.strerror})", path=path) from error
        if self._events is not None:
            with refusals_as_output_errors(self.folder / EVENTS):
                for key, value in row.items():
                    if value is not None and key != "step":
                        self._events.add_scalar(key, value, metrics.step)
                self._events.flush()

    def draw(self, maps: SampleMaps | None) -> None:
        """Update curves.png, and maps.png if maps are given."""
        rows = read_metrics(self.folder / METRICS)
        columns = {
            field.name: [getattr(row, field.name) for row in rows] for field in fields(Metrics)
        }
        write_bytes(self.folder / CURVES, png_bytes(training_figure(columns), dpi=110))
        if maps is None:
            return
        figure = observation_map_figure(
            maps.sparse, maps.dense, {"true map, gaps filled": maps.truth}, error_deg=maps.error_deg
        )
        write_bytes(self.folder / TRAINING_MAPS, figure)


def read_metrics(path: Path) -> list[Metrics]:
    """Return the lines of a complete metrics.csv."""
    return [_parse(line) for line in path.read_text("utf-8").splitlines()[1:]]


def none_for_nan(value: float) -> float | None:
    """Return the value, or None for NaN, which marks a term that was not computed."""
    return None if math.isnan(value) else value


def _parse(line: str) -> Metrics:
    """Return the numbers in a line. Raises ValueError if it is damaged."""
    row = dict(zip(_HEADER.split(","), line.split(","), strict=True))
    values: dict[str, Any] = {key: float(value) if value else None for key, value in row.items()}
    return Metrics(**{**values, "step": int(row["step"]), "pixels": int(row["pixels"])})


def _drop_lines_after(step: int, path: Path) -> Path | None:
    """Remove the lines of later steps from a metrics.csv, or the whole file if no line is left.

    A file that cannot be read is renamed to an unused name, which is returned.
    """
    try:
        kept = _lines_until(step, path)
    except ValueError:
        ending = free_name(".damaged", lambda name: path.with_suffix(f"{name}.csv").exists())
        aside = path.with_suffix(f"{ending}.csv")
        with refusals_as_output_errors(aside):
            path.replace(aside)
        return aside
    if kept:
        write_text(path, "\n".join([_HEADER, *kept]) + "\n")
    else:  # The run stopped before its first checkpoint, or a link leads nowhere.
        with refusals_as_output_errors(path):
            path.unlink(missing_ok=True)
    return None


def _lines_until(step: int, path: Path) -> list[str]:
    """Return the lines up to a step, without the last one if it was truncated by a full disk.

    Raises ValueError.
    """
    if not path.exists():
        return []
    if not path.is_file() or path.stat().st_size > 1 << 26:  # about half a million lines
        raise ValueError("it is not a checkpoint")
    header, *lines = path.read_text("utf-8").splitlines()
    if header != _HEADER:
        raise ValueError("another version wrote it")
    kept = []
    for number, line in enumerate(lines, 1):
        try:
            if _parse(line).step <= step:
                kept.append(line)
        except ValueError:
            if number < len(lines):
                raise
    return kept


FORMAT = "splinecli-checkpoint-2"


class RunCounters(Struct, forbid_unknown_fields=True):
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
    """Write the complete state of a run. Raises OutputError.

    It includes the running average of the weights and the SHA-256 of each pixel set.
    """
    tensors: dict[str, Tensor] = {}
    for prefix, module in (("network", network), ("average", average)):
        tensors |= {f"{prefix}.{name}": tensor for name, tensor in module.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
    contiguous = torch.contiguous_format
    plain = {
        name: tensor.detach().cpu().clone(memory_format=contiguous)
        for name, tensor in tensors.items()
    }
    metadata = {
        "format": FORMAT,
        "config": json.dumps(config.to_dict()),
        "clock": json.dumps(to_builtins(counters)),
        "sets": json.dumps(sets),
        "tensors_sha256": tensors_sha256(plain),
    }
    write_bytes(path, serialise(plain, metadata))


def read_checkpoint_config(path: Path) -> TrainingConfig:
    """Read the configuration of the run that wrote a checkpoint. Raises ModelError."""
    _, metadata = _read(path)
    return TrainingConfig.from_dict(read_json_entry(metadata, "config", path))


def load_checkpoint(
    path: Path,
    network: SplineNet,
    average: SplineNet,
    optimizer: torch.optim.Optimizer,
    sets: dict[str, str],
) -> RunCounters:
    """Restore networks and optimiser from a checkpoint, in place, and return the counters of the
    run.

    Raises ModelError if the file is missing, damaged or from another network, or if a pixel set has
    changed.
    """
    tensors, metadata = _read(path)
    for name, sha256 in read_json_entry(metadata, "sets", path, dict[str, str]).items():
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
        optimizer.load_state_dict(
            {"state": states, "param_groups": optimizer.state_dict()["param_groups"]}
        )
    except (TypeError, ValueError, KeyError) as error:
        raise ModelError(f"the checkpoint is incomplete ({error})", path=path) from error
    counters: RunCounters = read_json_entry(metadata, "clock", path, RunCounters)
    return counters


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    hint = "Start a run without --resume. If this file is damaged, remove it or choose another -o"
    return read_tensors(path, FORMAT, hint)
