"""`splinecli import-weights`: the written file works, and refusals."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splinecli.networks.li_net import PaperLINet
from splinecli.networks.ne_net import PaperNENet

# Our module names and theirs. tests/networks/test_official.py checks what the networks compute.
NE_NET = {
    "stem.": "conv1.",
    "dense1.first.": "denseblock1_1.1.",
    "dense1.second.": "denseblock1_2.1.",
    "transition1.": "transition.1.",
    "dense2.first.": "denseblock2_1.1.",
    "dense2.second.": "denseblock2_2.1.",
    "transition2.": "conv2.",
    "hidden.": "dense.0.",
    "out.": "dense.1.",
}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("authors")
    torch.manual_seed(0)
    li_net = {name.replace("layers", "main"): value for name, value in PaperLINet().state_dict().items()}
    ne_net = {}
    for name, value in PaperNENet(2, 32).state_dict().items():
        module = next(module for module in NE_NET if name.startswith(module))
        ne_net[name.replace(module, NE_NET[module])] = value
    torch.save(li_net, folder / "9-G.ckpt")
    torch.save(ne_net, folder / "9-D.ckpt")
    return folder / "9-G.ckpt", folder / "9-D.ckpt"


@pytest.fixture(autouse=True)
def here(checkpoints, tmp_path, monkeypatch):
    """Both checkpoints under short names in the working folder."""
    monkeypatch.chdir(tmp_path)
    for path in checkpoints:
        Path(path.name).symlink_to(path)


def test_imported_weights_run(run, make_capture):
    result = run("import-weights", "9-G.ckpt", "9-D.ckpt", "-o", "new/official.safetensors")
    assert (result.code, result.out, result.err) == (0, "new/official.safetensors\n", "")
    assert [path.name for path in Path("new").iterdir()] == ["official.safetensors"]
    few = np.zeros((24, 24), np.uint8)
    few[10:14, 10:14] = 255
    cv2.imwrite("few.png", few)
    weights = ("--weights", "new/official.safetensors")
    result = run("infer", make_capture("sphere"), "--mask", "few.png", *weights, "--json")
    (report,) = json.loads(result.out)
    assert (report["weights"]["name"], report["n_pixels"]) == ("official", 16)
    quiet = run("import-weights", "9-G.ckpt", "9-D.ckpt", "-o", "new/official.safetensors", "--overwrite", "-q")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_refusals(refuse):
    Path("notes.txt").write_text("no weights\n")
    Path("there.safetensors").touch()
    cases = (
        (4, ["9-D.ckpt", "9-G.ckpt", "-o", "new.safetensors"]),
        (4, ["9-G.ckpt", "notes.txt", "-o", "new.safetensors"]),
        (4, ["9-G.ckpt", "none.ckpt", "-o", "new.safetensors"]),
        (5, ["9-G.ckpt", "9-D.ckpt", "-o", "."]),
        (5, ["9-G.ckpt", "9-D.ckpt", "-o", "there.safetensors"]),
        (5, ["9-G.ckpt", "9-D.ckpt", "-o", "notes.txt/new.safetensors"]),
        (2, ["9-G.ckpt", "9-D.ckpt"]),
        (2, ["9-G.ckpt", "-o", "new.safetensors"]),
    )
    refuse("import-weights", cases, "import_weights_refusals.txt")
    assert not Path("new.safetensors").exists()
    assert Path("there.safetensors").read_bytes() == b""


def test_a_checkpoint_in_place_of_weights_gets_a_hint(run, make_capture):
    result = run("infer", make_capture("sphere"), "--weights", "9-G.ckpt")
    assert result.code == 4
    assert "splinecli import-weights" in result.err
