"""Weight files in safetensors format, with metadata and a checksum of the tensors. Nothing is
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

# Largest size of a tensor file in bytes. A checkpoint of the paper's networks has 170 MB.
LONGEST = 500_000_000
LENGTH_BYTES = 8  # bytes at the start of a safetensors file that contain the length of the header
Module = TypeVar("Module", bound=nn.Module)
SHIPPED = resources.files("splinecli") / "assets"


def tensors_sha256(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 of the names, types, shapes and bytes of tensors, sorted by name."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def read_tensors(
    path: Path, expected_format: str, hint: str
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the metadata of a safetensors file of splinecli.

    The format and the checksum are verified. Raises ModelError, with the hint, if the file is
    missing, damaged or in another format.
    """
    try:
        if path.is_dir():
            raise ModelError("found a folder, expected a weight file", path, hint=hint)
        if is_special(path):
            raise ModelError("this is not a file", path, hint=hint)
        if not path.is_file():
            raise ModelError("the file does not exist", path, hint=hint)
        check_length(path, hint)
        with path.open("rb") as start:
            length = int.from_bytes(start.read(LENGTH_BYTES), "little")
            if length > 1 << 20:  # a tensor needs about 100 bytes
                raise SafetensorError(f"the header has {length} bytes")
            with safe_open(utf8_name(path, start), framework="pt") as file:
                metadata = file.metadata() or {}
                found = metadata.get("format", "none")
                if found != expected_format:
                    raise ModelError(
                        f"found the format {found}, expected {expected_format}",
                        path,
                        hint=hint,
                    )
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError) as error:
        raise ModelError(
            f"this is not a safetensors file, or it is truncated ({error})", path, hint=hint
        ) from error
    if metadata.get("tensors_sha256") != tensors_sha256(tensors):
        raise ModelError(
            "the file is damaged: its tensors do not match its checksum", path, hint=hint
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
    """Return the JSON object in an entry of a file's metadata, optionally as a record of this kind.

    The checksum does not cover the metadata. Raises ModelError.
    """
    try:
        return parse_json(metadata.get(key, ""), kind)
    except ValueError as error:
        raise ModelError(f"the entry {key!r} in the file is not valid ({error})", path) from error


def load_strictly(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load the tensors into the network.

    Raises ModelError for a missing, unknown or misshapen tensor.
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
            f"the shipped weights {name!r} were modified: their SHA-256 is not in weights.json",
            hint="Reinstall splinecli",
        )
