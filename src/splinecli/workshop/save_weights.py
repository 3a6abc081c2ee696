"""Write weight files, which are safetensors with a checksum of the tensors."""

import json
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor, nn

from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import WEIGHTS_FORMAT
from splinecli.system.files import write_bytes
from splinecli.system.weight_files import LENGTH_BYTES, tensors_sha256


def save_weights(network: SplineNet, path: Path) -> None:
    """Write the parameters of a network as float16, with its configuration. Raises OutputError."""
    config = json.dumps(network.config.to_dict(), sort_keys=True)
    save_module(network, path, {"format": WEIGHTS_FORMAT, "config": config})


def serialise(tensors: dict[str, Tensor], metadata: dict[str, str]) -> bytes:
    """Return the bytes of a safetensors file, identical for identical content.

    The library itself writes the metadata in random order.
    """
    content = save(tensors, metadata)
    length = int.from_bytes(content[:LENGTH_BYTES], "little")
    header = json.loads(content[LENGTH_BYTES : LENGTH_BYTES + length])
    header["__metadata__"] = dict(sorted(metadata.items()))
    ordered = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    ordered += b" " * (-len(ordered) % LENGTH_BYTES)  # tensors start at a multiple of 8 bytes
    return (
        len(ordered).to_bytes(LENGTH_BYTES, "little") + ordered + content[LENGTH_BYTES + length :]
    )


def save_module(module: nn.Module, path: Path, metadata: dict[str, str]) -> None:
    """Write the parameters of a module as float16, with metadata and their checksum. Raises
    OutputError.
    """
    half = {name: tensor.detach().cpu().half() for name, tensor in module.state_dict().items()}
    tensors = {
        name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in half.items()
    }
    write_bytes(path, serialise(tensors, {**metadata, "tensors_sha256": tensors_sha256(tensors)}))
