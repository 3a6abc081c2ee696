"""The authors' own weights of SPLINE-Net (Zheng et al., ICCV 2019), turned into a network of ours.

Their PyTorch code saves two state dictionaries, NUMBER-G.ckpt (LI-Net) and NUMBER-D.ckpt (NE-Net). The paper size
has the same layers; what differs is put into the weights once, so that nothing has to be turned round later:

- Rows: in their maps y grows with the row, in ours it falls. Every kernel is turned over along its height, and the
  columns of the first linear layer along the rows of the map that they read. All paddings are symmetric and all
  sizes even, so that the network of turned-over kernels maps turned-over maps just as theirs maps maps.
- Channels: theirs are (dense, sparse), ours (sparse, dense).
- Cells and disc: the configuration's grid "cnn-ps".

Normals are taken to be in our frame: x right, y up, z to the camera.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor, nn

from splinecli.errors import ModelError
from splinecli.networks.config import NetworkConfig
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import load_strictly

# Module by module, our name to theirs: LI-Net's sequences are called otherwise, NE-Net's modules one by one.
_LI_NET_SEQUENCE = ("layers", "main")
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
# What their instance norms track in training. The authors normalise by each map's own statistics, at test time as
# well (they never leave the training mode), so these numbers were never used.
_TRACKED = ("running_mean", "running_var", "num_batches_tracked")
_MOST_NAMES = 5


def import_official(li_net_file: Path, ne_net_file: Path) -> SplineNet:
    """The authors' network, float32, in evaluation mode: dropout, which their test leaves on, is off.

    Args:
        li_net_file: their generator's state dictionary (G).
        ne_net_file: their discriminator's, which estimates the normals (D).

    Raises:
        ModelError: a file cannot be read or is no state dictionary; a tensor is missing, unknown, of another
            shape or not finite.
    """
    network = SplineNet(NetworkConfig(size="paper", grid="cnn-ps"))
    assert network.li_net is not None  # this configuration interpolates
    tensors = _flip_rows(_read_li_net(li_net_file, network.li_net), "li_net.")
    ne_net = _read_ne_net(ne_net_file, network.ne_net)
    side = network.config.map_size // 2
    ne_net["hidden.weight"] = _flip_columns(ne_net["hidden.weight"], side)
    ne_net["stem.weight"] = ne_net["stem.weight"].flip(1)
    tensors |= _flip_rows(ne_net, "ne_net.")
    load_strictly(network, tensors, li_net_file)
    return network.eval()


def _flip_rows(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors with every kernel, the 4-dimensional ones, turned over along its height."""
    return {prefix + name: tensor.flip(2) if tensor.ndim == 4 else tensor for name, tensor in tensors.items()}


def _flip_columns(weight: Tensor, side: int) -> Tensor:
    """A linear layer's weight (out, C * side * side) for features whose rows are turned over."""
    return weight.reshape(len(weight), -1, side, side).flip(2).flatten(1)


def _read_li_net(path: Path, li_net: nn.Module) -> dict[str, Tensor]:
    ours, theirs = _LI_NET_SEQUENCE
    names = {name: name.replace(ours, theirs) for name in li_net.state_dict()}
    tracked: dict[str, torch.Size] = {}
    for name, module in li_net.named_modules():
        if isinstance(module, nn.InstanceNorm2d):
            width = torch.Size([module.num_features])
            shapes = (width, width, torch.Size([]))
            tracked |= {
                f"{name}.{key}".replace(ours, theirs): shape
                for key, shape in zip(_TRACKED, shapes, strict=True)
            }
    return _rename(path, _read_state(path), li_net, names, tracked)


def _read_ne_net(path: Path, ne_net: nn.Module) -> dict[str, Tensor]:
    names = {}
    for name in ne_net.state_dict():
        module, _, parameter = name.rpartition(".")
        names[name] = f"{_NE_NET_MODULES[module]}.{parameter}"
    return _rename(path, _read_state(path), ne_net, names, {})


def _rename(
    path: Path,
    state: dict[str, Tensor],
    network: nn.Module,
    names: dict[str, str],
    dropped: dict[str, torch.Size],
) -> dict[str, Tensor]:
    """Their tensors under our names, float32, with every one of the file accounted for.

    Args:
        names: our name -> theirs, each of which has to be there.
        dropped: their names and shapes of tensors that may be there and are of no use.
    """
    hint = "Give the authors' NUMBER-G.ckpt first and NUMBER-D.ckpt second"
    shapes = {theirs: network.state_dict()[ours].shape for ours, theirs in names.items()}
    missing = [name for name in shapes if name not in state]
    if missing:
        raise ModelError(f"lacks {_listed(missing)}", path=path, hint=hint)
    shapes |= dropped
    unknown = [name for name in state if name not in shapes]
    if unknown:
        raise ModelError(f"holds {_listed(unknown)}, which the network does not have", path=path, hint=hint)
    for name, tensor in state.items():
        if tensor.shape != shapes[name]:
            found, expected = tuple(tensor.shape), tuple(shapes[name])
            raise ModelError(f"tensor {name!r} has the shape {found}, expected {expected}", path=path)
    for name in names.values():
        if not state[name].is_floating_point():
            raise ModelError(f"tensor {name!r} is of {state[name].dtype}, expected real numbers", path=path)
        # As float16, which weight files hold.
        if not torch.isfinite(state[name].half()).all():
            raise ModelError(f"tensor {name!r} holds values that are not finite, or too large", path=path)
    return {ours: state[theirs].float() for ours, theirs in names.items()}


def _read_state(path: Path) -> dict[str, Tensor]:
    """The tensors of a file that torch.save wrote. Nothing but tensors and plain containers is unpickled."""
    hint = "Give a checkpoint of the authors' PyTorch code, such as 200000-G.ckpt"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what torch mutters about odd files is said below, or not needed
            state = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ModelError(f"cannot be read ({error.strerror or error})", path=path, hint=hint) from error
    except Exception as error:  # a damaged pickle fails in a dozen ways
        raise ModelError("not a PyTorch checkpoint, or damaged", path=path, hint=hint) from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(tensor, Tensor) for name, tensor in state.items()
    ):
        raise ModelError("not a state dictionary, names with their tensors", path=path, hint=hint)
    return state


def _listed(names: Iterable[str]) -> str:
    quoted = [repr(name) for name in names]
    more = len(quoted) - _MOST_NAMES
    return ", ".join(quoted[:_MOST_NAMES]) + (f" and {more} more tensors" if more > 0 else "")
