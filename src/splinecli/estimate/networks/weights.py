"""The weight files of the networks that estimate normals: the shipped ones, and those that `train`
writes.
"""

import json
import os
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from splinecli.errors import ModelError, did_you_mean
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.li_ne_net import CaptureHead
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.system.files import expanded, file_sha256
from splinecli.system.weight_files import (
    SHIPPED,
    check_shipped,
    load_shipped,
    load_strictly,
    read_json_entry,
    read_tensors,
)

WEIGHTS_FORMAT = "splinecli-weights-1"
HEAD_FORMAT = "splinecli-capture-head-1"


@dataclass(frozen=True)
class LoadedNetwork:
    """A network ready to estimate normals (float32, evaluation mode)."""

    network: SplineNet
    name: str  # the shipped name, or the file name without its suffix
    sha256: str  # SHA-256 of the weight file


def load_weights(path: Path, *, name: str | None = None) -> LoadedNetwork:
    """Load the network in a weight file, named `name` or after the file without its suffix. Raises
    ModelError.
    """
    names = ", ".join(shipped_names())
    writers = "'splinecli train' or 'splinecli import-weights'"
    hint = f"--weights takes a file written by {writers}, or one of the names {names}"
    tensors, metadata = read_tensors(path, WEIGHTS_FORMAT, hint)
    config = NetworkConfig.from_dict(read_json_entry(metadata, "config", path))
    # This allocates no memory, because the configuration may request any size.
    with torch.device("meta"):
        sizes = {key: tensor.to("meta") for key, tensor in tensors.items()}
        load_strictly(SplineNet(config), sizes, path)
    network = SplineNet(config)
    load_strictly(network, tensors, path)
    for key, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise ModelError(f"tensor {key!r} has values that are not finite", path)
    network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return LoadedNetwork(network, name or path.stem, file_sha256(path))


def shipped_names() -> list[str]:
    """Return the names of the weights in the package."""
    return sorted(manifest())


def manifest() -> dict[str, dict[str, Any]]:
    """Return the entries of assets/weights.json, which describe the shipped weights, by name.

    Each entry has `file`, `sha256`, `method`, `description`, and `lights`, the fewest and most
    lights in training. Some have `capture_head`, the `file` and `sha256` of the head that adjusts
    the confidence using the whole capture, and `material_net`, those of the net that predicts
    materials from the tokens of their set branch.
    """
    entries: dict[str, dict[str, Any]] = json.loads((SHIPPED / "weights.json").read_text("utf-8"))
    return entries


def untrained_warning(sha256: str, n_lights: int) -> list[str]:
    """Return a warning if these are shipped weights that were not trained with this number of
    lights.
    """
    for name, entry in manifest().items():
        fewest, most = entry["lights"]
        if entry["sha256"] == sha256 and not fewest <= n_lights <= most:
            trained = f"{fewest}" if fewest == most else f"{fewest} to {most}"
            return [f"The weights {name} were trained with {trained} lights, not {n_lights}."]
    return []


def resolve_weights(name_or_file: str) -> LoadedNetwork:
    """Load shipped weights by name, or a weight file by path. Raises ModelError."""
    entry = manifest().get(name_or_file)
    if entry is None:
        path = expanded(name_or_file)
        # os.path is false for names that are too long for a file, where Path raises.
        if path.suffix != ".safetensors" and path.parent == Path() and not os.path.exists(path):  # noqa: PTH110
            names = ", ".join(shipped_names())
            raise ModelError(
                f"no weights named {name_or_file!r}; expected one of {names}, or a .safetensors"
                " file",
                hint=did_you_mean(name_or_file, shipped_names()),
            )
        return load_weights(path)
    with resources.as_file(SHIPPED / entry["file"]) as path:
        check_shipped(path, entry["sha256"], name_or_file)
        return load_weights(path, name=name_or_file)


def capture_head(sha256: str) -> CaptureHead | None:
    """Load the capture head for weights with this checksum, or None if they have none. Raises
    ModelError.
    """
    for entry in manifest().values():
        if entry["sha256"] == sha256 and "capture_head" in entry:
            return load_shipped(CaptureHead(), entry["capture_head"], HEAD_FORMAT)
    return None
