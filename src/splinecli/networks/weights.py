"""Weight files and the import of the original weights (Zheng et al., ICCV 2019).

A weight file is a safetensors file with the configuration of the network and a checksum. Nothing is unpickled.

The authors' PyTorch code saves two state dictionaries, NUMBER-G.ckpt (LI-Net) and NUMBER-D.ckpt (NE-Net). Our network
of size "paper" has the same layers but different conventions. The import converts the weights once:

- Rows: y increases with the row in their maps and decreases in ours. Every kernel is flipped along its height, and so
  are the map rows read by the first linear layer. All paddings are symmetric and all sizes even, so the result is the
  flipped result of their network.
- Channels: theirs are (dense, sparse), ours are (sparse, dense).
- Cells and disc: the setting grid = "cnn-ps".

Their normals are assumed to be in our frame: x right, y up, z to the camera.
"""

import hashlib
import json
import os
import pickletools
import warnings
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from splinecli.errors import InputError, ModelError
from splinecli.networks.config import NetworkConfig
from splinecli.networks.li_ne_net import CaptureHead
from splinecli.networks.light_net import LightNet
from splinecli.networks.material_net import MaterialNet
from splinecli.networks.spline_net import SplineNet
from splinecli.system.files import check_file, expanded, file_sha256, is_special, parse_json, utf8_name, write_bytes

FORMAT = "splinecli-weights-1"
HEAD_FORMAT = "splinecli-capture-head-1"
MATERIAL_FORMAT = "splinecli-material-net-1"
LIGHT_NET, LIGHT_FORMAT = "light-net.safetensors", "splinecli-light-net-1"
LONGEST = 500_000_000  # largest tensor file to read, in bytes; a checkpoint of the paper's networks has 170 MB
_LENGTH_BYTES = 8  # size of the header length at the start of a safetensors file
Module = TypeVar("Module", bound=nn.Module)

SHIPPED = resources.files("splinecli") / "assets"


@dataclass(frozen=True)
class LoadedNetwork:
    """A network ready to estimate normals (float32, evaluation mode)."""

    network: SplineNet
    name: str  # the shipped name, or the file name without its suffix
    sha256: str  # SHA-256 of the weight file


def tensors_sha256(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 of the tensors' names, types, shapes and bytes, sorted by name."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def serialise(tensors: dict[str, Tensor], metadata: dict[str, str]) -> bytes:
    """Return the bytes of a safetensors file, identical for identical content.

    The library itself writes the metadata in random order.
    """
    content = save(tensors, metadata)
    length = int.from_bytes(content[:_LENGTH_BYTES], "little")
    header = json.loads(content[_LENGTH_BYTES : _LENGTH_BYTES + length])
    header["__metadata__"] = dict(sorted(metadata.items()))
    ordered = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    ordered += b" " * (-len(ordered) % _LENGTH_BYTES)  # tensors start at a multiple of 8 bytes
    return len(ordered).to_bytes(_LENGTH_BYTES, "little") + ordered + content[_LENGTH_BYTES + length :]


def save_weights(network: SplineNet, path: Path) -> None:
    """Write the parameters of a network as float16, with its configuration. Raises OutputError."""
    config = json.dumps(network.config.to_dict(), sort_keys=True)
    save_module(network, path, {"format": FORMAT, "config": config})


def save_module(module: nn.Module, path: Path, metadata: dict[str, str]) -> None:
    """Write the parameters of a module as float16, with metadata and their checksum. Raises OutputError."""
    half = {name: tensor.detach().cpu().half() for name, tensor in module.state_dict().items()}
    tensors = {name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in half.items()}
    write_bytes(path, serialise(tensors, {**metadata, "tensors_sha256": tensors_sha256(tensors)}))


def read_tensors(path: Path, expected_format: str, hint: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a safetensors file of splinecli, and verify its format and checksum.

    Raises ModelError, with the hint, if the file is missing, damaged or in another format.
    """
    try:
        if path.is_dir():
            raise ModelError("is a folder", path=path, hint=hint)
        if is_special(path):
            raise ModelError("is not a file", path=path, hint=hint)
        if not path.is_file():
            raise ModelError("no such file", path=path, hint=hint)
        check_length(path, hint)
        with path.open("rb") as start:
            if (length := int.from_bytes(start.read(_LENGTH_BYTES), "little")) > 1 << 20:  # a tensor takes about 100
                raise SafetensorError(f"a header of {length} bytes")
            with safe_open(utf8_name(path, start), framework="pt") as file:
                metadata = file.metadata() or {}
                found = metadata.get("format", "none")
                if found != expected_format:
                    problem = f"wrong format: found {found}, expected {expected_format}"
                    raise ModelError(problem, path=path, hint=hint)
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError) as error:
        raise ModelError(f"not a safetensors file, or cut short ({error})", path=path, hint=hint) from error
    if metadata.get("tensors_sha256") != tensors_sha256(tensors):
        raise ModelError("damaged: the tensors do not match the checksum in the file", path=path, hint=hint)
    return tensors, metadata


def check_length(path: Path, hint: str) -> None:
    """Raise ModelError for a file of more than LONGEST bytes."""
    if (length := path.stat().st_size) > LONGEST:
        found = f"found {length / 1e6:.0f} MB, expected at most {LONGEST / 1e6:.0f}"
        raise ModelError(found, path=path, hint=hint)


def read_json_entry(metadata: dict[str, str], key: str, path: Path, kind: Any = dict[str, Any]) -> Any:
    """Return the JSON object under a key of a file's metadata, or the record of this kind. Raises ModelError.

    The checksum does not cover it.
    """
    try:
        return parse_json(metadata.get(key, ""), kind)
    except ValueError as error:
        raise ModelError(
            f"the entry {key!r} in the file is not JSON of the expected form ({error})", path=path
        ) from error


def load_strictly(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load the tensors into the network. Raises ModelError for a missing, unknown or misshapen tensor."""
    try:
        network.load_state_dict(tensors, strict=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(f"the tensors do not fit the configuration ({reason})", path=path) from error


def load_weights(path: Path, *, name: str | None = None) -> LoadedNetwork:
    """Load the network in a weight file, named `name` or after the file without its suffix. Raises ModelError."""
    names = ", ".join(shipped_names())
    writers = "'splinecli train' or 'splinecli import-weights'"
    hint = f"--weights takes a file written by {writers}, or one of the names {names}"
    tensors, metadata = read_tensors(path, FORMAT, hint)
    config = NetworkConfig.from_dict(read_json_entry(metadata, "config", path))
    with torch.device("meta"):  # allocates no memory, because the configuration may request any size
        load_strictly(SplineNet(config), {key: tensor.to("meta") for key, tensor in tensors.items()}, path)
    network = SplineNet(config)
    load_strictly(network, tensors, path)
    for key, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise ModelError(f"tensor {key!r} has values that are not finite", path=path)
    network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return LoadedNetwork(network, name or path.stem, file_sha256(path))


def shipped_names() -> list[str]:
    """Return the names of the weights in the package."""
    return sorted(manifest())


def manifest() -> dict[str, dict[str, Any]]:
    """Return the entries of assets/weights.json, which describe the shipped weights, by name.

    Each entry has `file`, `sha256`, `method`, `description`, and `lights`, the fewest and most lights in training. Some
    have `capture_head`, the `file` and `sha256` of the head that adjusts the confidence using the whole capture, and
    `material_net`, those of the net that predicts materials from the tokens of their set branch.
    """
    entries: dict[str, dict[str, Any]] = json.loads((SHIPPED / "weights.json").read_text("utf-8"))
    return entries


def untrained_warning(sha256: str, n_lights: int) -> list[str]:
    """Return a warning if these are shipped weights that were not trained with this number of lights."""
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
            raise ModelError(f"no weights named {name_or_file!r}; expected one of {names}, or a .safetensors file")
        return load_weights(path)
    with resources.as_file(SHIPPED / entry["file"]) as path:
        _check_shipped(path, entry["sha256"], name_or_file)
        return load_weights(path, name=name_or_file)


def capture_head(sha256: str) -> CaptureHead | None:
    """Load the capture head for weights with this checksum, or None if they have none. Raises ModelError."""
    for entry in manifest().values():
        if entry["sha256"] == sha256 and "capture_head" in entry:
            return _load_shipped(CaptureHead(), entry["capture_head"], HEAD_FORMAT)
    return None


def material_networks() -> tuple[SplineNet, MaterialNet]:
    """Load spline-net, whose tokens describe materials, and the material net. Raises ModelError."""
    shipped = manifest()["spline-net"]["material_net"]
    return resolve_weights("spline-net").network, _load_shipped(MaterialNet(), shipped, MATERIAL_FORMAT).float().eval()


def _load_shipped(module: Module, entry: dict[str, str], expected_format: str) -> Module:
    """Return the module with the parameters of an entry of weights.json. Raises ModelError."""
    with resources.as_file(SHIPPED / entry["file"]) as path:
        _check_shipped(path, entry["sha256"], path.stem)
        return _load_module(module, path, expected_format)


@cache
def light_net() -> LightNet:
    """Load the light network (float32, evaluation mode). Raises ModelError."""
    with resources.as_file(SHIPPED / LIGHT_NET) as path:
        return _load_module(LightNet(), path, LIGHT_FORMAT).float().eval()


def _load_module(module: Module, path: Path, expected_format: str) -> Module:
    """Return the module with the parameters of a shipped file. Raises ModelError."""
    load_strictly(module, read_tensors(path, expected_format, "Reinstall splinecli")[0], path)
    return module


def _check_shipped(path: Path, sha256: str, name: str) -> None:
    if file_sha256(path) != sha256:
        raise ModelError(
            f"the shipped weights {name!r} were changed: their SHA-256 does not match weights.json",
            hint="Reinstall splinecli",
        )


# Module names in NE-Net, ours and the authors'. In LI-Net, the names of the sequences differ.
_NE_NET_MODULES = {
    "stem": "conv1",
    "dense1.first": "denseblock1_1.1",
    "dense1.second": "denseblock1_2.1",
    "transition1": "transition.1",
    "dense2.first": "denseblock2_1.1",
    "dense2.second": "denseblock2_2.1",
    "transition2": "conv2",
    "hidden": "dense.0",
    "out": "dense.1",
}
# Limits: records in an archive, bytes and instructions in a pickle. The authors' have dozens, 10 kB and 2,000.
_MOST_RECORDS, _LONGEST_PICKLE, _MOST_STEPS = 10_000, 1 << 20, 100_000


def import_official(li_net_file: Path, ne_net_file: Path) -> SplineNet:
    """Return the authors' network, float32, in evaluation mode, from two files of state dictionaries.

    Their generator (G) is LI-Net, their discriminator (D) is NE-Net. Dropout is disabled in evaluation mode, but the
    authors' test code leaves it enabled. Raises ModelError if a file cannot be read or is not a
    state dictionary, or a tensor is missing, unknown, of another shape or not finite.
    """
    network = SplineNet(NetworkConfig(size="paper", grid="cnn-ps"))
    assert network.li_net is not None  # this configuration interpolates
    tensors = _flip_rows(_read_li_net(li_net_file, network.li_net), "li_net.")
    parts = (name.rpartition(".") for name in network.ne_net.state_dict())
    names = {f"{module}.{kind}": f"{_NE_NET_MODULES[module]}.{kind}" for module, _, kind in parts}
    ne_net = _rename(ne_net_file, network.ne_net, names, {})
    side = network.config.map_size // 2
    hidden = ne_net["hidden.weight"]
    ne_net["hidden.weight"] = hidden.reshape(len(hidden), -1, side, side).flip(2).flatten(1)
    ne_net["stem.weight"] = ne_net["stem.weight"].flip(1)
    tensors |= _flip_rows(ne_net, "ne_net.")
    load_strictly(network, tensors, li_net_file)
    return network.eval()


def _flip_rows(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Flip every kernel (every 4-dimensional tensor) along its height."""
    return {prefix + name: tensor.flip(2) if tensor.ndim == 4 else tensor for name, tensor in tensors.items()}


def _read_li_net(path: Path, li_net: nn.Module) -> dict[str, Tensor]:
    names = {name: name.replace("layers", "main") for name in li_net.state_dict()}
    # Running statistics that their instance norms collect in training. The authors' code normalises by the statistics
    # of each map, even at test time (it never leaves training mode), so these values are not used.
    tracked: dict[str, torch.Size] = {}
    for name, tensor in li_net.state_dict().items():
        norm, _, kind = names[name].rpartition(".")
        if kind == "weight" and tensor.ndim == 1:
            tracked |= {f"{norm}.running_mean": tensor.shape, f"{norm}.running_var": tensor.shape}
            tracked[f"{norm}.num_batches_tracked"] = torch.Size([])
    return _rename(path, li_net, names, tracked)


def _rename(path: Path, network: nn.Module, names: dict[str, str], dropped: dict[str, torch.Size]) -> dict[str, Tensor]:
    """Return their tensors under our names, float32; `names` maps ours to theirs, `dropped` lists unused shapes."""
    state = _read_state(path)
    hint = "Give the authors' NUMBER-G.ckpt first and NUMBER-D.ckpt second"
    shapes = {theirs: network.state_dict()[ours].shape for ours, theirs in names.items()}
    missing = [name for name in shapes if name not in state]
    if missing:
        raise ModelError(f"has no {_listed(missing)}", path=path, hint=hint)
    shapes |= dropped
    unknown = [name for name in state if name not in shapes]
    if unknown:
        raise ModelError(f"has {_listed(unknown)}, which the network does not have", path=path, hint=hint)
    for name, tensor in state.items():
        if tensor.shape != shapes[name]:
            found, expected = tuple(tensor.shape), tuple(shapes[name])
            raise ModelError(f"tensor {name!r} has the shape {found}, expected {expected}", path=path)
    for name in names.values():
        if not state[name].is_floating_point():
            raise ModelError(f"tensor {name!r} is of {state[name].dtype}, expected real numbers", path=path)
        # Weight files are float16.
        if not torch.isfinite(state[name].half()).all():
            raise ModelError(f"tensor {name!r} has values that are not finite, or too large", path=path)
    return {ours: state[theirs].float() for ours, theirs in names.items()}


def _read_state(path: Path) -> dict[str, Tensor]:
    """Read the tensors in a file written by torch.save. Only tensors and plain containers are unpickled."""
    hint = "Give a checkpoint of the authors' PyTorch code, such as 200000-G.ckpt"
    try:
        check_file(path, "a checkpoint")
        check_length(path, hint)
        _check_content(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the errors below cover the PyTorch warnings
            state = torch.load(path, map_location="cpu", weights_only=True)
    except InputError as error:
        raise ModelError(error.problem, path=path, hint=hint) from error
    except ModelError:
        raise
    except OSError as error:
        raise ModelError(f"cannot be read ({error.strerror or error})", path=path, hint=hint) from error
    except Exception as error:  # damaged pickles raise many types of errors
        raise ModelError("not a PyTorch checkpoint, or damaged", path=path, hint=hint) from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str)
        and isinstance(tensor, Tensor)
        and (tensor.layout == torch.strided and tensor.device.type == "cpu" and not tensor.is_quantized)
        for name, tensor in state.items()
    ):
        raise ModelError("not a state dictionary (tensors by name)", path=path, hint=hint)
    return state


def _check_content(path: Path) -> None:
    """Raise ValueError for a checkpoint that would use far more memory than its file size.

    It may be an archive with uncompressed records, as written by torch.save since 1.6, or pickles and numbers.
    """
    with path.open("rb") as file:
        if file.read(4) == b"PK\3\4":
            # Count the records before reading the directory, which has one such mark for each record.
            if sum(part.count(b"PK\1\2") for part in iter(lambda: file.read(1 << 20), b"")) > _MOST_RECORDS:
                raise ValueError("too many records")
            records = zipfile.ZipFile(file).infolist()
            expanded = sum(record.file_size for record in records)
            pickled = sum(record.file_size for record in records if record.filename.endswith(".pkl"))
            if expanded > path.stat().st_size or pickled > _LONGEST_PICKLE:
                raise ValueError("records that are compressed, or too many tensors")
            return
        file.seek(0)
        steps = 0
        for _ in range(5):  # a mark, the version, the system, the tensors, and the names of their numbers
            for _ in pickletools.genops(file):
                steps += 1
                if steps > _MOST_STEPS:
                    raise ValueError("too many tensors")


def _listed(names: Iterable[str]) -> str:
    quoted = [repr(name) for name in names]
    more = len(quoted) - 5
    return ", ".join(quoted[:5]) + (f" and {more} more tensors" if more > 0 else "")
