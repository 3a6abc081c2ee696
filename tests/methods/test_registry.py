"""Methods by name."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splinecli.errors import ModelError, UsageError
from splinecli.methods import MethodOptions, make_estimator, method_names
from splinecli.networks.config import NetworkConfig
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import save_weights
from tiny_networks import TINY

LIGHTS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.48, -0.36, 0.8]])


def save_tiny(path: Path, **settings: Any) -> str:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_weights(SplineNet(NetworkConfig(**TINY, **settings)), path)
    return str(path)


@pytest.fixture
def weights(tmp_path: Path) -> str:
    return save_tiny(tmp_path / "tiny.safetensors")


def test_every_method_says_what_it_is_and_estimates(weights: str, tmp_path: Path) -> None:
    truth = np.array([[0.0, 0.0, 1.0], [0.28, 0.0, 0.96], [0.0, -0.28, 0.96]])
    observations = (truth @ LIGHTS.T * 0.5).astype(np.float32)
    alone = save_tiny(tmp_path / "alone.safetensors", interpolates=False)
    fingerprints = set()
    for name in method_names():
        file = alone if name == "cnn-ps" else weights
        estimator = make_estimator(name, MethodOptions(weights=file, device="cpu", precision="float32"))
        assert estimator.name == name
        assert estimator.device == "cpu"
        fingerprints.add(estimator.fingerprint)
        # A matte pixel without shadow is easy for all of them; the network starts from the Lambertian fit.
        normals = estimator.estimate(observations, LIGHTS)
        assert normals.shape == (3, 3)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)
        np.testing.assert_allclose(normals, truth, atol=0.01)
    assert len(fingerprints) == len(method_names())


def test_what_decides_the_normals_is_in_the_fingerprint(weights: str) -> None:
    options = MethodOptions(weights=weights, device="cpu", precision="float32")
    others = (replace(options, rotations=3), replace(options, precision="bfloat16"))
    fingerprints = {make_estimator("spline-net", o).fingerprint for o in (options, *others)}
    assert len(fingerprints) == 3
    same = make_estimator("spline-net", replace(options, batch_size=3))
    assert same.fingerprint in fingerprints


def test_weights_of_the_other_network(weights: str, tmp_path: Path) -> None:
    alone = save_tiny(tmp_path / "alone.safetensors", interpolates=False)
    for method, file, message in (
        ("cnn-ps", weights, "'tiny' are for SPLINE-Net; the method cnn-ps .* Use them with --method spline-net"),
        ("spline-net", alone, "'alone' are for CNN-PS; the method spline-net .* Use them with --method cnn-ps"),
    ):
        with pytest.raises(ModelError, match=message):
            make_estimator(method, MethodOptions(weights=file))


@pytest.mark.parametrize("options", [MethodOptions(rotations=0), MethodOptions(batch_size=0)])
def test_counts_from_one(options: MethodOptions, weights: str) -> None:
    with pytest.raises(UsageError, match="whole numbers from 1"):
        make_estimator("spline-net", replace(options, weights=weights))
