"""Weight files: safetensors with their network's configuration and a checksum. Nothing is ever unpickled."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from splinecli.errors import ModelError
from splinecli.files import file_sha256, write_bytes
from splinecli.networks.config import NetworkConfig
from splinecli.networks.spline_net import SplineNet

FORMAT = "splinecli-weights-1"
SHIPPED = resources.files("splinecli") / "assets"


@dataclass(frozen=True)
class LoadedNetwork:
    """A network ready to estimate (float32, evaluation mode), the name it was asked by, the SHA-256."""

    network: SplineNet
    name: str
    sha256: str


def tensors_sha256(tensors: dict[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def save_weights(network: SplineNet, path: Path) -> None:
    """Write the network's parameters as float16 with its configuration. Raises OutputError."""
    tensors = {
        name: tensor.detach().cpu().half().clone(memory_format=torch.contiguous_format)
        for name, tensor in network.state_dict().items()
    }
    metadata = {
        "format": FORMAT,
        "config": json.dumps(network.config.to_dict(), sort_keys=True),
        "tensors_sha256": tensors_sha256(tensors),
    }
    write_bytes(path, save(tensors, metadata))


def read_tensors(path: Path, expected_format: str, hint: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of one of splinecli's safetensors files, checked against the checksum inside.

    Raises ModelError where the file is missing, is no such file, or is damaged; `hint` says where a right one
    is had.
    """
    try:
        if path.is_dir():
            raise ModelError("is a folder", path=path, hint=hint)
        if not path.is_file():
            raise ModelError("no such file", path=path, hint=hint)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            found = metadata.get("format", "no format entry")
            if found != expected_format:
                problem = f"not splinecli's: found {found}, expected {expected_format}"
                raise ModelError(problem, path=path, hint=hint)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError) as error:
        raise ModelError(f"not a safetensors file, or cut short ({error})", path=path, hint=hint) from error
    if metadata.get("tensors_sha256") != tensors_sha256(tensors):
        raise ModelError("damaged: the tensors do not match the checksum in the file", path=path, hint=hint)
    return tensors, metadata


def read_json_entry(metadata: dict[str, str], key: str, path: Path) -> dict[str, Any]:
    """The JSON object under a key of a file's metadata, which no checksum covers. Raises ModelError."""
    try:
        values = json.loads(metadata.get(key, ""))
    except json.JSONDecodeError as error:
        raise ModelError(f"the entry {key!r} in the file is not JSON", path=path) from error
    if not isinstance(values, dict):
        raise ModelError(f"the entry {key!r} in the file is not a JSON object", path=path)
    return values


def load_strictly(network: SplineNet, tensors: dict[str, Tensor], path: Path) -> None:
    """Fill the network; every tensor must be there, of its shape, and no other. Raises ModelError."""
    try:
        network.load_state_dict(tensors, strict=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(f"the tensors do not fit the configuration ({reason})", path=path) from error


def load_weights(path: Path, *, name: str | None = None) -> LoadedNetwork:
    """Rebuild the network of a weight file. Raises ModelError."""
    names = ", ".join(shipped_names())
    writers = "'splinecli train' or 'splinecli import-weights'"
    hint = f"--weights takes a file written by {writers}, or one of the names {names}"
    tensors, metadata = read_tensors(path, FORMAT, hint)
    network = SplineNet(NetworkConfig.from_dict(read_json_entry(metadata, "config", path)))
    load_strictly(network, tensors, path)
    for key, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise ModelError(f"tensor {key!r} holds values that are not finite", path=path)
    network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return LoadedNetwork(network, name or path.stem, file_sha256(path))


def shipped_names() -> list[str]:
    """Names of the weights that come in the package."""
    return sorted(manifest())


def manifest() -> dict[str, dict[str, Any]]:
    """name -> {file, sha256, method, description, lights: [fewest, most] in training} of the shipped weights."""
    entries: dict[str, dict[str, Any]] = json.loads((SHIPPED / "weights.json").read_text("utf-8"))
    return entries


def untrained_warning(sha256: str, n_lights: int) -> list[str]:
    """A sentence where these are shipped weights that were not trained with so many lights; else none."""
    for name, entry in manifest().items():
        fewest, most = entry["lights"]
        if entry["sha256"] == sha256 and not fewest <= n_lights <= most:
            trained = f"{fewest}" if fewest == most else f"{fewest} to {most}"
            return [f"The weights {name} were trained with {trained} lights, not {n_lights}."]
    return []


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name too long for a file
        return False


def resolve_weights(name_or_file: str) -> LoadedNetwork:
    """Load shipped weights by name, or a file by path. Raises ModelError."""
    entry = manifest().get(name_or_file)
    if entry is None:
        path = Path(name_or_file)
        if path.suffix != ".safetensors" and path.parent == Path() and not _exists(path):
            names = ", ".join(shipped_names())
            raise ModelError(
                f"no weights named {name_or_file!r}; expected one of {names}, or a .safetensors file"
            )
        return load_weights(path)
    with resources.as_file(SHIPPED / entry["file"]) as path:
        loaded = load_weights(path, name=name_or_file)
    if loaded.sha256 != entry["sha256"]:
        raise ModelError(
            f"the shipped weights {name_or_file!r} were changed: their SHA-256 is not the manifest's",
            hint="Reinstall splinecli",
        )
    return loaded
