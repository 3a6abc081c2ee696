"""The authors' weights of the paper's size.

The authors' architecture, built here from its description, is the oracle of the import: both
networks get random weights, are saved as the authors save theirs, imported, and asked the same
questions.
"""

import pickle
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.testing import assert_close

from distributions import seeded
from scenes import parametrize, refuses
from splinecli.errors import ModelError
from splinecli.workshop.import_weights import import_official

SIDE = 32


class Residual(nn.Module):
    def __init__(self):
        super().__init__()
        first, second = (nn.Conv2d(256, 256, 3, padding=1, bias=False) for _ in range(2))
        self.main = nn.Sequential(*joined(first, 256), second, norm(256))

    def forward(self, x):
        return self.main(x) + x


def norm(channels):
    return nn.InstanceNorm2d(channels, affine=True, track_running_stats=True)


def joined(conv, channels):
    return [conv, norm(channels), nn.ReLU()]


class AuthorsLINet(nn.Module):
    """G: always in training mode, where an instance norm that tracks statistics does not use
    them.
    """

    def __init__(self):
        super().__init__()
        down = {"kernel_size": 4, "stride": 2, "padding": 1, "bias": False}
        self.main = nn.Sequential(
            *joined(nn.Conv2d(1, 64, 7, padding=3, bias=False), 64),
            *joined(nn.Conv2d(64, 128, **down), 128),
            *joined(nn.Conv2d(128, 256, **down), 256),
            *(Residual() for _ in range(6)),
            *joined(nn.ConvTranspose2d(256, 128, **down), 128),
            *joined(nn.ConvTranspose2d(128, 64, **down), 64),
            nn.Conv2d(64, 1, 7, padding=3, bias=False),
            nn.Sigmoid(),
        )

    def forward(self, sparse):
        place = torch.arange(SIDE) / (SIDE - 1) * 2 - 1
        inside = torch.hypot(place[:, None], place) < 1
        return self.main(sparse) * inside


class AuthorsNENet(nn.Module):
    """D, on (dense, sparse)."""

    def __init__(self):
        super().__init__()

        def grow(channels):
            return nn.Sequential(
                nn.ReLU(), nn.Conv2d(channels, 16, 3, padding=1), nn.Dropout2d(0.2)
            )

        self.conv1 = nn.Conv2d(2, 16, 3, padding=1)
        self.denseblock1_1, self.denseblock1_2 = grow(16), grow(32)
        self.transition = nn.Sequential(
            nn.ReLU(), nn.Conv2d(48, 48, 1), nn.Dropout2d(0.2), nn.AvgPool2d(4, stride=2, padding=1)
        )
        self.denseblock2_1, self.denseblock2_2 = grow(48), grow(64)
        self.conv2 = nn.Conv2d(80, 80, 1)
        self.dense = nn.Sequential(nn.Linear(20480, 128), nn.Linear(128, 3))

    def forward(self, maps):
        x = self.conv1(maps)
        x = torch.cat((x, self.denseblock1_1(x)), 1)
        x = self.transition(torch.cat((x, self.denseblock1_2(x)), 1))
        x = torch.cat((x, self.denseblock2_1(x)), 1)
        x = self.conv2(torch.cat((x, self.denseblock2_2(x)), 1))
        return nn.functional.normalize(self.dense(x.flatten(1)), dim=1)


@pytest.fixture(scope="module")
def authors():
    """Both networks with random values everywhere, LI-Net in training mode as it always is."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        li_net, ne_net = AuthorsLINet(), AuthorsNENet()
        for name, tensor in li_net.state_dict().items():
            if (
                tensor.is_floating_point() and tensor.ndim == 1
            ):  # scales, offsets, tracked statistics
                tensor.uniform_(0.5, 2.0) if "var" in name or "weight" in name else tensor.normal_()
        li_net.main[-2].weight.data *= 5  # type: ignore[operator, assignment]  # so that the answers differ
    return li_net.requires_grad_(False), ne_net.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def files(authors, tmp_path_factory):
    """Both state dictionaries as torch.save writes them."""
    folder = tmp_path_factory.mktemp("authors")
    paths = folder / "200000-G.ckpt", folder / "200000-D.ckpt"
    for network, path in zip(authors, paths, strict=True):
        torch.save(network.state_dict(), path)
    return paths


@pytest.fixture(scope="module")
def imported(files):
    return import_official(*files)


@pytest.fixture
def changed(authors, files, tmp_path):
    """Save LI-Net's state (NE-Net's with of=1) with tensors replaced, or left out where None is
    given.
    """

    def change(changes, of=0):
        state = {**authors[of].state_dict(), **changes}
        path = tmp_path / "changed.ckpt"
        torch.save({name: tensor for name, tensor in state.items() if tensor is not None}, path)
        return (path, files[1]) if of == 0 else (files[0], path)

    return change


def maps(seed, channels=1):
    return torch.rand(3, channels, SIDE, SIDE, generator=seeded(seed))


def embed(observations, lights):
    """Their observation maps (P, 1, 32, 32): q * 32 + p, with p from x and q from y, floor((n + 1)
    31 / 2).
    """
    p, q = (0.5 * (lights.numpy()[:, :2] + 1) * (SIDE - 1)).astype(np.int32).T
    filled = np.zeros((len(observations), SIDE * SIDE), np.float32)
    filled[:, q * SIDE + p] = (observations / observations.amax(1, keepdim=True)).numpy()
    return torch.as_tensor(filled).view(-1, 1, SIDE, SIDE)


def test_observations_give_the_normals_that_theirs_give(authors, imported):
    generator = seeded(4)
    observations = torch.rand(6, 10, generator=generator) * 3
    lights = torch.randn(10, 3, generator=generator).abs() * torch.tensor((1.0, 1.0, 1.5))
    lights[::2, 0] *= -1
    lights[::3, 1] *= -1
    lights = nn.functional.normalize(lights, dim=1)
    sparse = embed(observations, lights)
    assert (sparse > 0).sum() == 60  # no two lights share a cell, where theirs keeps the last
    expected = authors[1](torch.cat((authors[0](sparse), sparse), 1))
    with torch.no_grad():
        normals = imported(observations, lights).normals
        views = imported.build_maps(observations, lights)
    assert_close(views.sparse.flip(2), sparse, atol=1e-7, rtol=0)
    assert_close(normals, expected, atol=1e-5, rtol=0)
    assert expected.std(0).max() > 1e-3


def test_files_of_old_and_without_statistics(authors, imported, changed, tmp_path):
    # PyTorch 0.4 wrote another container, and did not count the batches at first.
    old = tmp_path / "old-G.ckpt", tmp_path / "old-D.ckpt"
    for network, path in zip(authors, old, strict=True):
        uncounted = (
            name for name in network.state_dict() if not name.endswith("num_batches_tracked")
        )
        state = {name: network.state_dict()[name] for name in uncounted}
        torch.save(state, path, _use_new_zipfile_serialization=False)
    tracked = dict.fromkeys(
        name for name in authors[0].state_dict() if "running" in name or "num_batches" in name
    )
    assert len(tracked) == 3 * 17
    for paths in (old, changed(tracked)):
        again = import_official(*paths).state_dict()
        assert (
            all(
                torch.equal(again.pop(name), tensor)
                for name, tensor in imported.state_dict().items()
            )
            and not again
        )


@parametrize(
    "of, changes, message",
    [
        (0, {"main.0.weight": None}, "has no 'main.0.weight'"),
        (0, {"main.0.bias": torch.zeros(64)}, "has 'main.0.bias', which the network does not have"),
        (
            0,
            {"main.3.weight": torch.zeros(128, 64, 3, 3)},
            r"\(128, 64, 3, 3\), expected \(128, 64, 4, 4\)",
        ),
        (
            0,
            {"main.1.num_batches_tracked": torch.zeros(1)},
            r"num_batches_tracked' has the shape \(1,\)",
        ),
        (
            0,
            {"main.1.bias": torch.full((64,), torch.nan)},
            "'main.1.bias' has values that are not finite",
        ),
        (0, {"main.1.bias": torch.full((64,), 1e6)}, "'main.1.bias' has values .* too large"),
        (0, {"main.1.bias": torch.zeros(64, dtype=torch.int64)}, "'main.1.bias' is of torch.int64"),
        (1, {"conv2.bias": None, "dense.1.weight": None}, "has no 'conv2.bias', 'dense.1.weight'"),
        (
            1,
            {f"{n}": torch.zeros(1) for n in range(7)},
            "has '0', '1', '2', '3', '4' and 2 more tensors,",
        ),
    ],
)
def test_tensors_that_do_not_fit(changed, of, changes, message):
    with refuses(message, ModelError):
        import_official(*changed(changes, of))


def deflated(path):
    torch.save({"a": torch.zeros(5_000_000)}, path)
    with zipfile.ZipFile(path) as archive:
        records = {record.filename: archive.read(record) for record in archive.infolist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in records.items():
            archive.writestr(name, content)


def countless_records(path):
    torch.save({"a": torch.zeros(3)}, path)
    with zipfile.ZipFile(path, "a") as archive:
        for number in range(10_500):
            archive.writestr(f"archive/extra/{number}", b"")


def countless_tensors(path, new=True):
    empty = torch.zeros(0)
    torch.save(
        {str(number): empty[:0] for number in range(16_000)},
        path,
        _use_new_zipfile_serialization=new,
    )


OLD_TENSORS = partial(countless_tensors, new=False)


@parametrize("write", [deflated, countless_records, countless_tensors, OLD_TENSORS])
def test_checkpoints_that_expand_are_refused_unread(write, files, tmp_path, monkeypatch):
    write(tmp_path / "G.ckpt")
    monkeypatch.setattr(torch, "load", None)
    with refuses(r"G\.ckpt: not a PyTorch checkpoint, or damaged", ModelError) as error:
        import_official(tmp_path / "G.ckpt", files[1])
    assert type(error.value.__cause__) is ValueError


def test_files_that_are_no_checkpoints(files, tmp_path):
    class Bomb:
        def __reduce__(self):
            return Path.touch, (tmp_path / "exploded",)

    path = tmp_path / "odd.ckpt"
    whole = files[0].read_bytes()
    contents = [
        b"",
        b"not a checkpoint\n",
        b"\0" * 64,
        whole[:1000],
        whole[:-1000],
        pickle.dumps(Bomb()),
    ]
    contents += [b"PK\x03\x04" + b"\0" * 100, pickle.dumps({"weight": 1})]
    for content in contents:
        path.write_bytes(content)
        with refuses("not a PyTorch checkpoint, or damaged", ModelError):
            import_official(path, files[1])
    without_numbers = {"a": torch.zeros(3).to_sparse()}, {"a": torch.zeros(3, device="meta")}
    for value in (
        torch.zeros(3),
        {"main.0.weight": 3},
        {3: torch.zeros(1)},
        ["main"],
        None,
        *without_numbers,
    ):
        torch.save(value, path)
        with refuses("not a state dictionary", ModelError):
            import_official(path, files[1])
    torch.save({"network": Bomb()}, path)
    with refuses("not a PyTorch checkpoint", ModelError):
        import_official(path, files[1])
    assert not (tmp_path / "exploded").exists()
    for missing, reason in (
        (tmp_path / "none.ckpt", "the file does not exist"),
        (tmp_path, "found a folder"),
    ):
        with refuses(reason, ModelError):
            import_official(missing, files[1])
