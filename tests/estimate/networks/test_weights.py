"""Weight files are read as they were written, and other files are refused."""

import hashlib
import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.testing import assert_close

from scenes import parametrize, put, refuses
from splinecli.errors import ModelError
from splinecli.estimate.networks import weights
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import WEIGHTS_FORMAT, load_weights, resolve_weights
from splinecli.system.weight_files import tensors_sha256
from splinecli.workshop.save_weights import save_weights
from tiny_networks import TINY, random_network


@pytest.fixture
def saved(tmp_path):
    save_weights(random_network(), tmp_path / "tiny.safetensors")
    return tmp_path / "tiny.safetensors"


def write_like_splinecli(path, network, tensors, **changes):
    metadata = {"format": WEIGHTS_FORMAT, "config": json.dumps(network.config.to_dict())}
    save_file(tensors, path, metadata | {"tensors_sha256": tensors_sha256(tensors)} | changes)


@parametrize("settings", [{}, {"size": "paper", "map_size": 8}])
def test_round_trip(tmp_path, settings):
    network = random_network(**settings)
    path = tmp_path / "tiny.safetensors"
    save_weights(network, path)
    loaded = load_weights(path)
    assert loaded.network.config == network.config
    assert not loaded.network.training
    assert loaded.name == "tiny"
    assert loaded.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    for name, tensor in network.state_dict().items():
        # float16 keeps 11 bits.
        assert_close(loaded.network.state_dict()[name], tensor, rtol=2**-11, atol=2**-24)


def test_every_tensor_and_no_other(tmp_path):
    network, path = random_network(), tmp_path / "odd.safetensors"
    tensors = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    write_like_splinecli(path, network, tensors)
    load_weights(path)
    first, *others = tensors
    more, less = tensors | {"extra": torch.zeros(1)}, {name: tensors[name] for name in others}
    for changed in (more, less, tensors | {first: tensors[first][:-1].clone()}):
        write_like_splinecli(path, network, changed)
        with refuses("do not fit the configuration", ModelError):
            load_weights(path)


@parametrize("config", ["", "{", "3", '["width"]', '{"width": -1}', '{"height": 3}'])
def test_a_configuration_that_cannot_be(tmp_path, config):
    network = random_network()
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    write_like_splinecli(tmp_path / "odd.safetensors", network, tensors, config=config)
    with pytest.raises(ModelError):
        load_weights(tmp_path / "odd.safetensors")


class TensorsMade(TorchFunctionMode):
    """Notes the elements of all tensors that functions of PyTorch return, but for those without
    memory.
    """

    made: tuple[int, ...] = ()

    def __torch_function__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if isinstance(result, Tensor) and not result.is_meta:
            self.made += (result.numel(),)
        return result


@parametrize(
    "settings",
    [
        {"width": 4096, "head_width": 4096, "map_size": 128},
        {"width": 4096, "li_blocks": 64, "ne_blocks": 64},
        {"set_width": 4096, "set_layers": 64},
        {"li_blocks": 65},
    ],
)
def test_a_configuration_far_larger_than_the_tensors(tmp_path, settings):
    """It is refused without making its tensors, which would take gigabytes."""
    network, path = random_network(), tmp_path / "a.safetensors"
    config = json.dumps({**network.config.to_dict(), **settings})
    write_like_splinecli(path, network, dict(network.state_dict()), config=config)
    with (
        TensorsMade() as tensors,
        refuses(r"do not fit the configuration|from 1 to 64", ModelError),
    ):
        load_weights(path)
    assert max(tensors.made, default=0) < 1_000_000


def test_no_changed_byte_goes_unnoticed(saved):
    whole = saved.read_bytes()
    for position in range(0, len(whole), 61):
        saved.write_bytes(whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :])
        with pytest.raises(ModelError):
            load_weights(saved)
    saved.write_bytes(whole)
    load_weights(saved)


@parametrize("content", [b"", b"not weights\n", b"\x00" * 64, None])
def test_files_of_other_kinds(saved, content):
    saved.write_bytes(saved.read_bytes()[:-100] if content is None else content)
    with refuses("not a safetensors file", ModelError):
        load_weights(saved)


def test_somebody_else_s_safetensors(tmp_path):
    path = tmp_path / "other.safetensors"
    # bfloat16, which numpy does not know: the format is read before any tensor.
    save_file({"weight": torch.zeros(3, dtype=torch.bfloat16)}, path)
    with refuses("found the format none, expected splinecli-weights-1", ModelError):
        load_weights(path)


def test_nothing_is_unpickled(tmp_path):
    class Bomb:
        def __reduce__(self):
            return Path.touch, (tmp_path / "exploded",)

    path = tmp_path / "weights.pth"
    for write in (
        lambda: path.write_bytes(pickle.dumps(Bomb())),
        lambda: torch.save({"w": torch.zeros(3)}, path),
    ):
        write()
        with refuses("not a safetensors file", ModelError):
            resolve_weights(str(path))
    assert not (tmp_path / "exploded").exists()
    with refuses("found a folder", ModelError):
        resolve_weights(str(tmp_path))


def test_shipped_weights_by_name(saved, monkeypatch):
    monkeypatch.setattr(weights, "SHIPPED", saved.parent)
    entry = {"file": saved.name, "sha256": hashlib.sha256(saved.read_bytes()).hexdigest()}
    put(
        saved.parent / "weights.json",
        json.dumps({"good": entry, "bad": entry | {"sha256": "0" * 64}}),
    )
    assert resolve_weights("good").name == "good"
    assert resolve_weights(str(saved)).name == "tiny"
    with refuses("the shipped weights 'bad' were modified", ModelError):
        resolve_weights("bad")
    with refuses(r"expected one of bad, good, or a \.safetensors file", ModelError):
        resolve_weights("better")


def test_weights_that_are_not_finite(tmp_path):
    network = SplineNet(NetworkConfig(**TINY))
    with torch.no_grad():
        network.ne_net.out.bias[0] = float("nan")  # type: ignore[operator]
    save_weights(network, tmp_path / "nan.safetensors")
    with refuses("not finite", ModelError):
        load_weights(tmp_path / "nan.safetensors")


def test_countless_empty_tensors_are_refused_unread(tmp_path):
    empty = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    header = json.dumps({str(number): empty for number in range(30_000)}).encode()
    (tmp_path / "a.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
    with refuses(r"not a safetensors file, or it is truncated \(the header has \d+ b", ModelError):
        load_weights(tmp_path / "a.safetensors")


def test_round_trip_of_a_configuration():
    paper = NetworkConfig(size="paper", map_size=16, width=5, grid="cnn-ps", interpolates=False)
    for config in (paper, NetworkConfig(fits=("ia14", "ls"))):
        assert NetworkConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@parametrize(
    "values, message",
    [
        ({"grid": "odd"}, "network setting 'grid' is 'odd'; expected 'even' or 'cnn-ps'"),
        ({"grid": "cnn-ps"}, "network setting 'grid' is 'cnn-ps'; it needs the size 'paper'"),
        ({"size": "huge"}, "network setting 'size' is 'huge'; expected 'paper' or 'compact'"),
        ({"fits": ["cow"]}, r"'fits' has 'cow'; expected a list of ls, iw12, iw12-all, ia14"),
        ({"size": "paper", "fits": ["ls"]}, "'fits' needs the size 'compact'"),
        ({"interpolates": "no"}, "'interpolates' is 'no'; expected true or false"),
        ({"width": 0}, "network setting 'width' is 0; expected a whole number from 2 to 4096"),
        ({"sees_capture": True}, "'sees_capture' needs 'set_width'"),
        ({"set_width": 20}, "'set_width' is 20; expected a multiple of 16"),
        ({"size": "paper", "set_width": 16}, "'set_width' needs the size 'compact'"),
        (
            {"map_size": 30},
            "'map_size' is 30; expected a whole number from 8 to 128, a multiple of 4",
        ),
        ({"size": "paper", "error_head": True}, "'error_head' needs the size 'compact'"),
    ],
)
def test_refused(values, message):
    with refuses(message, ModelError):
        NetworkConfig.from_dict(values)
