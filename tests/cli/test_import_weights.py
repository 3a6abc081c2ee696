"""`splinecli import-weights`: the written file works, and refusals."""

from pathlib import Path

import numpy as np
import pytest
import torch

from estimate.networks.test_official import AuthorsLINet, AuthorsNENet
from scenes import names_in, put, write_image


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("authors")
    torch.manual_seed(0)
    torch.save(AuthorsLINet().state_dict(), folder / "9-G.ckpt")
    torch.save(AuthorsNENet().state_dict(), folder / "9-D.ckpt")
    return folder / "9-G.ckpt", folder / "9-D.ckpt"


@pytest.fixture(autouse=True)
def here(checkpoints):
    """Both checkpoints under short names in the working folder."""
    for path in checkpoints:
        Path(path.name).symlink_to(path)


def test_imported_weights_run(run, document, make_capture):
    run(
        "import-weights 9-G.ckpt 9-D.ckpt -o new/official.safetensors",
        out="new/official.safetensors\n",
        err="",
    )
    assert names_in("new") == {"official.safetensors"}
    few = np.zeros((24, 24), np.uint8)
    few[10:14, 10:14] = 255
    write_image("few.png", few)
    weights = "--weights new/official.safetensors"
    report = document(f"infer {make_capture('sphere')} --mask few.png {weights}")
    assert report["weights"]["name"] == "official"
    assert report["n_pixels"] == 16
    run(
        "import-weights 9-G.ckpt 9-D.ckpt -o new/official.safetensors --overwrite -q",
        out="",
        err="",
    )


def test_refusals(refuse):
    put("notes.txt", "no weights\n")
    Path("there.safetensors").touch()
    cases = """
        4 9-D.ckpt 9-G.ckpt -o new.safetensors
        4 9-G.ckpt notes.txt -o new.safetensors
        4 9-G.ckpt none.ckpt -o new.safetensors
        5 9-G.ckpt 9-D.ckpt -o .
        5 9-G.ckpt 9-D.ckpt -o there.safetensors
        5 9-G.ckpt 9-D.ckpt -o notes.txt/new.safetensors
        2 9-G.ckpt 9-D.ckpt
        2 9-G.ckpt -o new.safetensors
    """
    refuse("import-weights", cases)
    assert not Path("new.safetensors").exists()
    assert Path("there.safetensors").read_bytes() == b""
