"""SPLINE-Net as an estimator, the weights of the package, and the compared methods on two objects
of DiLiGenT.

The published errors are those of the papers and of the benchmark.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import torch
from numpy.random import default_rng
from pytest import approx

from scenes import (
    directions_at,
    evaluate,
    on_sphere,
    parametrize,
    put,
    read_json,
    shade,
    sphere,
    spiral_lights,
    vectors,
)
from splinecli.estimate.methods import MethodOptions, make_estimator
from splinecli.estimate.methods.batched import NetworkEstimator, rotations_of
from splinecli.estimate.methods.estimator import CONFIDENT_DEG
from splinecli.estimate.networks.li_ne_net import probability_within
from splinecli.estimate.networks.weights import LoadedNetwork, manifest, resolve_weights
from splinecli.evaluation.protocol import Protocol
from splinecli.lights.lighting import PixelLighting
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.system.weight_files import SHIPPED
from splinecli.workshop.synthesis.pixels import PixelGenerator, PixelGeneratorConfig
from splinecli.workshop.training.objective import to_pixel_frame
from tiny_networks import random_network


def pixels(count):
    rng = default_rng(0)
    lights = rng.normal(size=(10, 3)) + np.array((0, 0, 3))
    return rng.uniform(size=(count, 10)).astype(np.float32), unit(lights)


def estimator(network=None, **options):
    loaded = LoadedNetwork(network or random_network(), "random", "0" * 64)
    return NetworkEstimator("spline-net", loaded, **{"precision": "float32", **options})


def test_bfloat16_costs_little():
    observations, lights = pixels(50)
    exact = estimator().estimate(observations, lights)
    coarse = estimator(precision="bfloat16").estimate(observations, lights)
    error = angle_between_deg(coarse, exact)
    # 8 bits of mantissa on the correction alone, not on the fit.
    assert 0 < error.max() < 1


def test_rotations_of_a_canonical_network():
    for rotations in range(1, 20):
        several = rotations_of(rotations, canonical=True)
        assert len(set(several)) == rotations
        # Training turns by up to 15 degrees.
        assert max(abs(turn) for turn, _ in several) <= 15  # type: ignore[operator]


SEES = {"map_size": 16, "set_width": 16, "set_layers": 1, "error_head": True, "sees_capture": True}
PAPER = {"size": "paper", "map_size": 8}
QUARTER, MIRROR = vectors("0 -1 0; 1 0 0; 0 0 1"), np.diag((1.0, -1, 1))


@parametrize(
    "settings, turn, symmetric_from", [(PAPER, QUARTER, 4), ({}, MIRROR, 2), (SEES, MIRROR, 2)]
)
def test_rotations_make_a_network_symmetric(settings, turn, symmetric_from):
    """Four make the paper's fourfold symmetric, for turned lights only change their order; two make
    ours a mirror.
    """
    observations, lights = pixels(4)
    for rotations in (symmetric_from, 1):
        network = estimator(random_network(**settings), rotations=rotations)
        here, there = (
            network.estimate(observations, lights),
            network.estimate(observations, lights @ turn.T),
        )
        assert np.allclose(there, here @ turn.T, atol=1e-4) == (rotations > 1)


def test_progress_changes_no_bit():
    observations, lights = pixels(150)
    network = estimator(batch_size=100)
    done = []
    watched = network.estimate(observations, lights, progress=done.append)
    assert watched.tobytes() == network.estimate(observations, lights).tobytes()
    assert done == [100, 50]


def lighting_at(observations, lights):
    return lambda rows: PixelLighting(observations[rows], lights)


def row(n_pixels):
    """Return a mask (1, P) that fills its image, so that no pixel is at an outline."""
    return np.ones((1, n_pixels), np.bool_)


def test_pixels_see_their_capture_and_not_their_tile():
    observations, lights = pixels(600)
    network = estimator(random_network(**SEES), batch_size=100)
    whole = network.bind(lighting_at(observations, lights), row(600))
    expected, errors = whole.estimate_with_error(observations, lights)
    for tile in (slice(0, 30), slice(250, 600)):
        found, found_errors = whole.estimate_with_error(observations[tile], lights)
        assert angle_between_deg(found, expected[tile]).max() < 0.01
        assert np.allclose(found_errors, errors[tile], atol=1e-3)
    # Alone, the pixels of a call are a capture.
    assert angle_between_deg(network.estimate(observations, lights), expected).max() < 0.01
    assert angle_between_deg(network.estimate(observations[:30], lights), expected[:30]).max() > 0.1
    # The network that was given sees nothing of this capture.
    assert whole is not network and network._contexts == [None]


def test_a_black_background_says_nothing_of_the_object():
    observations, lights = pixels(200)
    network = estimator(random_network(**SEES))
    expected = network.estimate(observations, lights)
    dark = default_rng(1).uniform(0, 1e-3, (800, 10)).astype(np.float32)
    with_background = np.concatenate((dark[:400], observations, dark[400:]))
    found = network.bind(lighting_at(with_background, lights), row(1000)).estimate(
        with_background, lights
    )
    assert angle_between_deg(found[400:600], expected).max() < 0.01
    assert np.array_equal(network.estimate(0 * dark, lights), np.tile((0, 0, 1), (800, 1)))


def test_outline_pixels_that_the_object_covers_only_in_part_hardly_affect_the_others():
    """They affect the others less than without context, where all pixels of a call are sampled."""
    size, factor, lights = 32, 8, spiral_lights(10)
    normals, inside = sphere(size * factor)

    def photographed(values):
        return np.asarray(
            (values * inside[..., None]).reshape(size, factor, size, factor, -1).mean(axis=(1, 3))
        )

    covered = photographed(np.ones((*inside.shape, 1)))[..., 0]
    mask = covered > 0.3
    darker = photographed(shade(normals, lights, gloss=0.5))[mask].astype(np.float32)
    whole = (darker / covered[mask][:, None]).astype(np.float32)
    network = make_estimator("spline-net-pixelwise")

    def change_deg(context):
        before, after = (
            (network.bind(lighting_at(seen, lights), mask) if context else network).estimate(
                seen, lights
            )
            for seen in (whole, darker)
        )
        return angle_between_deg(before, after)[covered[mask] == 1].mean()

    assert change_deg(context=True) < 0.5 * change_deg(context=False)


# Mean angular errors in degrees, on Ball and Cat: ours, and the published ones. The published ones
# for all 96 lights are DiLiGenT's benchmark, those for ten lights are table 2 of Zheng et al. (ICCV
# 2019).
ALL_LIGHTS = {
    "ls": ((4.44, 8.00), (4.10, 8.41)),
    "iw12": ((2.11, 6.49), (2.54, 7.21)),
    "st14": ((1.76, 5.42), (1.74, 6.12)),
    "ia14": ((2.76, 4.82), (3.34, 6.74)),
}
TEN_LIGHTS = {
    "ls": ((4.75, 8.99), (4.41, 9.03)),
    "iw12": ((2.96, 7.77), (3.33, 8.13)),
    "st14": ((2.89, 6.63), (5.24, 9.34)),
    "ia14": ((3.19, 6.45), (12.94, 15.53)),
    "cnn-ps": ((9.91, 11.04), (17.86, 15.67)),
}

REPEATED_DEG = 0.1
"""Tolerance of our own errors. Draws and pixels are seeded, so only rounding differs between
machines.
"""

PUBLISHED_DEG = 0.5
"""How much worse than the published errors ours may be: the images have 16 bits and one channel,
and only some pixels are scored. Ours may be better: ST14 and IA14 have priors here that ten lights
need."""

OBJECTS = parametrize("place, name", [(0, "ballPNG"), (1, "catPNG")])


@OBJECTS
def test_all_lights(shared_data, place, name):
    errors = mean_errors(
        shared_data / f"DiLiGenT/pmsData/{name}",
        [*ALL_LIGHTS],
        Protocol(max_pixels=1000, as_stored=True),
    )
    check(errors, ALL_LIGHTS, place)


@OBJECTS
def test_ten_lights(shared_data, place, name):
    folder = shared_data / f"DiLiGenT/pmsData/{name}"
    fits = [method for method in TEN_LIGHTS if method != "cnn-ps"]
    errors = mean_errors(folder, fits, Protocol(10, trials=10, max_pixels=500, as_stored=True))
    # CNN-PS averages ten rotations of each pixel, so it gets fewer pixels.
    errors |= mean_errors(
        folder, ["cnn-ps"], Protocol(10, trials=3, max_pixels=150, as_stored=True)
    )
    check(errors, TEN_LIGHTS, place)
    # With ten lights CNN-PS is worse than least squares, in its paper as here.
    assert errors["cnn-ps"] > errors["ls"] + 1


def mean_errors(folder, methods, protocol):
    """Return the mean angular errors in degrees, by method."""
    estimators = [make_estimator(method) for method in methods]
    results = evaluate([folder], estimators, protocol).results
    return {result.method: result.mae_deg for result in results}


def check(errors, table, place):
    ours = {method: own[place] for method, (own, _) in table.items()}
    assert errors == approx(ours, abs=REPEATED_DEG)
    for method, (_, published) in table.items():
        assert errors[method] < published[place] + PUBLISHED_DEG, method
    # Least squares must not pass as one of the robust methods.
    assert all(errors[method] < errors["ls"] - 1 for method in ("iw12", "st14", "ia14"))


GOLDEN = Path(__file__).resolve().parents[2] / "golden/shipped_predictions.json"


def glossy_pixels(n_lights):
    """Normals (25, 3), lights (F, 3) on a spiral, and observations (25, F): Lambert's cosine and a
    Phong lobe.
    """
    grid = np.linspace(-0.7, 0.7, 5)
    x, y = (axis.ravel() for axis in np.meshgrid(grid * 0.9, grid * 0.9))
    normals = on_sphere(x, y)
    radius = 0.8 * np.sqrt((np.arange(n_lights) + 0.5) / n_lights)
    lights = directions_at(2.4 * np.arange(n_lights), np.arcsin(radius))
    return (
        normals,
        lights,
        np.float32(0.6 * shade(normals, lights, gloss=5 / 6, exponent=60)),
    )


@parametrize("name", sorted(manifest()))
def test_file(name):
    entry = manifest()[name]
    content = (SHIPPED / entry["file"]).read_bytes()
    assert len(content) <= 8e6
    assert hashlib.sha256(content).hexdigest() == entry["sha256"]
    assert resolve_weights(name).sha256 == entry["sha256"]


def test_confidence_on_generated_pixels():
    """Of all pixels with about the same confidence, that share is within the limit."""
    config = PixelGeneratorConfig(min_lights=10, usual_lights=10, max_lights=10, capture_pixels=64)
    batch = PixelGenerator(config, torch.Generator().manual_seed(77)).draw(64 * 300)
    network = resolve_weights("spline-net").network
    with torch.inference_mode():
        maps = network.build_maps(batch.observations, batch.light_directions, batch.valid)
        normals, error = network.estimate(maps, network.interpolate(maps), captures=batch.captures)
        truth = to_pixel_frame(batch.truth.normals, maps)
    error_deg = angle_between_deg(normals.numpy(), truth.numpy())
    confidence = probability_within(error, CONFIDENT_DEG).numpy()
    for fifth in np.array_split(confidence.argsort(), 5):
        assert (error_deg[fifth] <= CONFIDENT_DEG).mean() == approx(
            confidence[fifth].mean(), abs=0.06
        )


@parametrize("name", sorted(manifest()))
def test_stored_prediction(name, request):
    """The numbers of these very files; `pytest --update-golden` after new weights."""
    _, lights, observations = glossy_pixels(10)
    estimated = make_estimator(name, MethodOptions(precision="float32")).estimate(
        observations, lights
    )
    stored = read_json(GOLDEN)
    if request.config.getoption("--update-golden"):
        stored[name] = np.round(estimated, 4).tolist()
        put(GOLDEN, json.dumps(dict(sorted(stored.items()))) + "\n")
    # Other processors add up in another order; four decimals are 0.006 degrees.
    assert angle_between_deg(estimated, unit(np.array(stored[name]))).max() < 0.05
