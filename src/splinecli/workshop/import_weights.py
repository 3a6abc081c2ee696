"""Import of the original weights of SPLINE-Net (Zheng et al., ICCV 2019).

The authors' PyTorch code saves two state dictionaries, NUMBER-G.ckpt (LI-Net) and NUMBER-D.ckpt
(NE-Net). Our network of size "paper" has the same layers but different conventions. The import
converts the weights once:

- Rows: y increases with the row in their maps and decreases in ours. Every kernel is flipped along
  its height, and so are the map rows read by the first linear layer. All paddings are symmetric and
  all sizes even, so the result is the flipped result of their network.
- Channels: theirs are (dense, sparse), ours are (sparse, dense).
- Cells and disc: the setting grid = "cnn-ps".

Their normals are assumed to be in our frame: x right, y up, z to the camera.
"""

import pickletools
import warnings
import zipfile
from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor, nn

from splinecli.errors import InputError, ModelError
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.system.files import check_file
from splinecli.system.weight_files import check_length, load_strictly

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


# Limits: records in an archive, bytes and instructions in a pickle. The authors' have dozens, 10 kB
# and 2,000.
_MOST_RECORDS, _LONGEST_PICKLE, _MOST_STEPS = 10_000, 1 << 20, 100_000


def import_official(li_net_file: Path, ne_net_file: Path) -> SplineNet:
    """Return the authors' network from two files of state dictionaries.

    It is float32, in evaluation mode. Their generator (G) is LI-Net, their discriminator (D) is
    NE-Net. Dropout is disabled in evaluation mode, but the authors' test code leaves it enabled.
    Raises ModelError if a file cannot be read or is not a state dictionary, or a tensor is missing,
    unknown, of another shape or not finite.
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
    return {
        prefix + name: tensor.flip(2) if tensor.ndim == 4 else tensor
        for name, tensor in tensors.items()
    }


def _read_li_net(path: Path, li_net: nn.Module) -> dict[str, Tensor]:
    names = {name: name.replace("layers", "main") for name in li_net.state_dict()}
    # Running statistics that their instance norms collect in training. The authors' code normalises
    # by the statistics of each map, even at test time (it never leaves training mode), so these
    # values are not used.
    tracked: dict[str, torch.Size] = {}
    for name, tensor in li_net.state_dict().items():
        norm, _, kind = names[name].rpartition(".")
        if kind == "weight" and tensor.ndim == 1:
            tracked |= {f"{norm}.running_mean": tensor.shape, f"{norm}.running_var": tensor.shape}
            tracked[f"{norm}.num_batches_tracked"] = torch.Size([])
    return _rename(path, li_net, names, tracked)


def _rename(
    path: Path, network: nn.Module, names: dict[str, str], dropped: dict[str, torch.Size]
) -> dict[str, Tensor]:
    """Return the authors' tensors under our names, float32.

    `names` maps ours to theirs, `dropped` lists unused shapes.
    """
    state = _read_state(path)
    hint = "Give the authors' NUMBER-G.ckpt first and NUMBER-D.ckpt second"
    shapes = {theirs: network.state_dict()[ours].shape for ours, theirs in names.items()}
    missing = [name for name in shapes if name not in state]
    if missing:
        raise ModelError(f"has no {_listed(missing)}", path=path, hint=hint)
    shapes |= dropped
    unknown = [name for name in state if name not in shapes]
    if unknown:
        raise ModelError(
            f"has {_listed(unknown)}, which the network does not have", path=path, hint=hint
        )
    for name, tensor in state.items():
        if tensor.shape != shapes[name]:
            found, expected = tuple(tensor.shape), tuple(shapes[name])
            raise ModelError(
                f"tensor {name!r} has the shape {found}, expected {expected}", path=path
            )
    for name in names.values():
        if not state[name].is_floating_point():
            raise ModelError(
                f"tensor {name!r} is of {state[name].dtype}, expected real numbers", path=path
            )
        # Weight files are float16.
        if not torch.isfinite(state[name].half()).all():
            raise ModelError(
                f"tensor {name!r} has values that are not finite, or too large", path=path
            )
    return {ours: state[theirs].float() for ours, theirs in names.items()}


def _read_state(path: Path) -> dict[str, Tensor]:
    """Return the tensors in a file written by torch.save. Only tensors and plain containers are
    unpickled.
    """
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
        raise ModelError(
            f"cannot be read ({error.strerror or error})", path=path, hint=hint
        ) from error
    except Exception as error:  # damaged pickles raise many types of errors
        raise ModelError("not a PyTorch checkpoint, or damaged", path=path, hint=hint) from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str)
        and isinstance(tensor, Tensor)
        and (
            tensor.layout == torch.strided
            and tensor.device.type == "cpu"
            and not tensor.is_quantized
        )
        for name, tensor in state.items()
    ):
        raise ModelError("not a state dictionary (tensors by name)", path=path, hint=hint)
    return state


def _check_content(path: Path) -> None:
    """Raise ValueError for a checkpoint that would need far more memory than its file size.

    It is either an archive with uncompressed records, as written by torch.save since version 1.6,
    or a sequence of pickles and numbers.
    """
    with path.open("rb") as file:
        if file.read(4) == b"PK\3\4":
            # Count the records by their marks in the directory before it is read.
            if (
                sum(part.count(b"PK\1\2") for part in iter(lambda: file.read(1 << 20), b""))
                > _MOST_RECORDS
            ):
                raise ValueError("too many records")
            records = zipfile.ZipFile(file).infolist()
            expanded = sum(record.file_size for record in records)
            pickled = sum(
                record.file_size for record in records if record.filename.endswith(".pkl")
            )
            if expanded > path.stat().st_size or pickled > _LONGEST_PICKLE:
                raise ValueError("records that are compressed, or too many tensors")
            return
        file.seek(0)
        steps = 0
        for _ in range(
            5
        ):  # a mark, the version, the system, the tensors, and the names of their numbers
            for _ in pickletools.genops(file):
                steps += 1
                if steps > _MOST_STEPS:
                    raise ValueError("too many tensors")


def _listed(names: Iterable[str]) -> str:
    quoted = [repr(name) for name in names]
    more = len(quoted) - 5
    return ", ".join(quoted[:5]) + (f" and {more} more tensors" if more > 0 else "")
