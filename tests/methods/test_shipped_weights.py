"""The weights that come in the package: their size, their checksum, and a small stored prediction."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from scenes import directions_at, shade
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.methods import MethodOptions, make_estimator
from splinecli.methods.estimator import CONFIDENT_DEG
from splinecli.networks.li_ne_net import probability_within
from splinecli.networks.spline_net import to_pixel_frame
from splinecli.networks.weights import SHIPPED, manifest, resolve_weights
from splinecli.synthesis.pixels import PixelGenerator, PixelGeneratorConfig

GOLDEN = Path(__file__).resolve().parents[1] / "golden/shipped_predictions.json"


def glossy_pixels(n_lights: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals (25, 3), lights (F, 3) on a spiral, and observations (25, F): Lambert's cosine and a Phong lobe."""
    grid = np.linspace(-0.7, 0.7, 5)
    x, y = (axis.ravel() for axis in np.meshgrid(grid * 0.9, grid * 0.9))
    normals = np.stack((x, y, np.sqrt(1 - x**2 - y**2)), axis=-1)
    radius = 0.8 * np.sqrt((np.arange(n_lights) + 0.5) / n_lights)
    lights = directions_at(2.4 * np.arange(n_lights), np.arcsin(radius))
    return normals, lights, (0.6 * shade(normals, lights, gloss=5 / 6, exponent=60)).astype(np.float32)


@pytest.mark.parametrize("name", sorted(manifest()))
def test_file(name):
    entry = manifest()[name]
    content = (SHIPPED / entry["file"]).read_bytes()
    assert len(content) <= 8e6
    assert hashlib.sha256(content).hexdigest() == entry["sha256"]
    assert resolve_weights(name).sha256 == entry["sha256"]


@pytest.mark.parametrize("n_lights", [8, 96])
def test_glossy_pixels_are_better_than_by_least_squares(n_lights):
    normals, lights, observations = glossy_pixels(n_lights)
    estimators = [make_estimator(name, MethodOptions(precision="float32")) for name in ("spline-net", "ls")]
    ours, plain = (estimator.estimate(observations, lights) for estimator in estimators)
    assert angle_between_deg(ours, normals).mean() < angle_between_deg(plain, normals).mean()


def test_confidence_on_generated_pixels():
    """Of all pixels with about the same confidence, that share is within the limit."""
    config = PixelGeneratorConfig(min_lights=10, usual_lights=10, max_lights=10, capture_pixels=64)
    batch = PixelGenerator(config, torch.Generator().manual_seed(77)).draw(64 * 100)
    network = resolve_weights("spline-net").network
    with torch.inference_mode():
        maps = network.build_maps(batch.observations, batch.light_directions, batch.valid)
        normals, error = network.estimate(maps, network.interpolate(maps), captures=batch.captures)
        truth = to_pixel_frame(batch.truth.normals, maps)
    error_deg = angle_between_deg(normals.numpy(), truth.numpy())
    confidence = probability_within(error, CONFIDENT_DEG).numpy()
    for fifth in np.array_split(confidence.argsort(), 5):
        assert (error_deg[fifth] <= CONFIDENT_DEG).mean() == pytest.approx(confidence[fifth].mean(), abs=0.06)


@pytest.mark.parametrize("name", sorted(manifest()))
def test_stored_prediction(name, request):
    """The numbers of these very files; `pytest --update-golden` after new weights."""
    _, lights, observations = glossy_pixels(10)
    estimated = make_estimator(name, MethodOptions(precision="float32")).estimate(observations, lights)
    stored = json.loads(GOLDEN.read_text("utf-8"))
    if request.config.getoption("--update-golden"):
        stored[name] = np.round(estimated, 4).tolist()
        GOLDEN.write_text(json.dumps(dict(sorted(stored.items()))) + "\n", "utf-8")
    # Other processors add up in another order; four decimals are 0.006 degrees.
    assert angle_between_deg(estimated, unit(np.array(stored[name]))).max() < 0.05
