"""Weight files: safetensors with a format, metadata and a checksum of the tensors. Nothing is
unpickled.
"""

import hashlib
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from splinecli.errors import ModelError
from splinecli.system.files import file_sha256, is_special, parse_json, utf8_name

# largest tensor file to read, in bytes; a checkpoint of the paper's networks has 170 MB
LONGEST = 500_000_000
LENGTH_BYTES = 8  # size of the header length at the start of a safetensors file
Module = TypeVar("Module", bound=nn.Module)
SHIPPED = resources.files("splinecli") / "assets"


def tensors_sha256(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 of the tensors' names, types, shapes and bytes, sorted by name."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def read_tensors(
    path: Path, expected_format: str, hint: str
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a safetensors file of splinecli, and verify its format
    and checksum.

    Raises ModelError, with the hint, if the file is missing, damaged or in another format.
    """
    try:
        if path.is_dir():
            raise ModelError("is a folder", path, hint=hint)
        if is_special(path):
            raise ModelError("is not a file", path, hint=hint)
        if not path.is_file():
            raise ModelError("no such file", path, hint=hint)
        check_length(path, hint)
        with path.open("rb") as start:
            length = int.from_bytes(start.read(LENGTH_BYTES), "little")
            if length > 1 << 20:  # a tensor takes about 100
                raise SafetensorError(f"a header of {length} bytes")
            with safe_open(utf8_name(path, start), framework="pt") as file:
                metadata = file.metadata() or {}
                found = metadata.get("format", "none")
                if found != expected_format:
                    raise ModelError(
                        f"wrong format: found {found}, expected {expected_format}",
                        path,
                        hint=hint,
                    )
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError) as error:
        raise ModelError(
            f"not a safetensors file, or cut short ({error})", path, hint=hint
        ) from error
    if metadata.get("tensors_sha256") != tensors_sha256(tensors):
        raise ModelError(
            "damaged: the tensors do not match the checksum in the file", path, hint=hint
        )
    return tensors, metadata


def check_length(path: Path, hint: str) -> None:
    """Raise ModelError for a file of more than LONGEST bytes."""
    if (length := path.stat().st_size) > LONGEST:
        found = f"found {length / 1e6:.0f} MB, expected at most {LONGEST / 1e6:.0f}"
        raise ModelError(found, path, hint=hint)


def read_json_entry(
    metadata: dict[str, str], key: str, path: Path, kind: Any = dict[str, Any]
) -> Any:
    """Return the JSON object under a key of a file's metadata, or the record of this kind. Raises
    ModelError.

    The checksum does not cover it.
    """
    try:
        return parse_json(metadata.get(key, ""), kind)
    except ValueError as error:
        raise ModelError(
            f"the entry {key!r} in the file is not JSON of the expected form ({error})", path
        ) from error


def load_strictly(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load the tensors into the network. Raises ModelError for a missing, unknown or misshapen
    tensor.
    """
    try:
        network.load_state_dict(tensors, strict=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(f"the tensors do not fit the configuration ({reason})", path) from error


def load_shipped(module: Module, entry: dict[str, str], expected_format: str) -> Module:
    """Return the module with the parameters of an entry of weights.json. Raises ModelError."""
    with resources.as_file(SHIPPED / entry["file"]) as path:
        check_shipped(path, entry["sha256"], path.stem)
        return load_module(module, path, expected_format)


def load_module(module: Module, path: Path, expected_format: str) -> Module:
    """Return the module with the parameters of a shipped file. Raises ModelError."""
    load_strictly(module, read_tensors(path, expected_format, "Reinstall splinecli")[0], path)
    return module


def check_shipped(path: Path, sha256: str, name: str) -> None:
    if file_sha256(path) != sha256:
        raise ModelError(
            f"the shipped weights {name!r} were changed: their SHA-256 does not match weights.json",
            hint="Reinstall splinecli",
        )
