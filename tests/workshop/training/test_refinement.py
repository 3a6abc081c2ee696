"""Whole scenes as captures, and the training of the refinement net on them."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from distributions import FAULTLESS, seeded
from scenes import refuses
from splinecli.errors import ModelError, UsageError
from splinecli.estimate.networks.refine_net import FEATURE_CHANNELS
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import load_weights, resolve_weights
from splinecli.maths.normals import unit
from splinecli.system.files import UNFINISHED
from splinecli.workshop.pixel_sets.store import Pixels, PixelSetWriter
from splinecli.workshop.save_weights import save_weights
from splinecli.workshop.synthesis.batches import CaptureConfig
from splinecli.workshop.synthesis.whole_capture import photograph_scene
from splinecli.workshop.training import CAPTURES, WEIGHTS, refinement, tasks
from splinecli.workshop.training.config import PRESETS
from splinecli.workshop.training.loop import Trainer
from splinecli.workshop.training.refinement import (
    STEPS_PER_CAPTURE,
    CaptureFolder,
    SceneMaps,
    ScenePool,
    refinement_losses,
    stack_maps,
)

CPU = torch.device("cpu")
PLAIN = CaptureConfig(**FAULTLESS, unequal_lights_share=0.0, ambient_share=0.0)


def scene(pixels=300, lights=8):
    generator = seeded(3)
    directions = torch.randn(lights, 3, generator=generator).abs()
    directions = normalize(directions, dim=1)
    return torch.rand(pixels, lights, generator=generator), directions


def test_ambient_light_is_the_same_in_all_images_of_a_capture():
    """It is between a share of the pixel's mean and of the capture's mean."""
    radiance, directions = scene()
    config = replace(PLAIN, ambient_share=1.0)
    observations, _, exposure = photograph_scene(radiance, directions, config, seeded(4))
    added = torch.where(observations < 1, observations / exposure - radiance, torch.nan)
    assert added.nan_to_num(0).amax(1).sub(added.nan_to_num(9).amin(1)).max() < 1e-5
    means = torch.stack(
        (radiance.mean(dim=1), torch.full((len(radiance),), float(radiance.mean()))), dim=1
    )
    shares = torch.linalg.lstsq(means, added.nanmean(1)).solution
    assert shares.min() > 0 and 10**-3.2 < shares.sum() < 0.1


def test_errors_of_calibration_are_those_of_the_capture():
    """Every pixel has the same factor under one light."""
    radiance, directions = scene()
    config = replace(PLAIN, light_intensity_error_share=1.0, unequal_lights_share=1.0)
    observations, *_ = photograph_scene(radiance, directions, config, seeded(1))
    factors = torch.where(radiance < 0.9, observations / radiance, torch.nan)
    spread = factors.nan_to_num(0).amax(0) - factors.nan_to_num(9).amin(0)
    assert spread.max() < 1e-5
    assert factors.nanmean(0).std() > 1e-3


def test_saturated_captures_are_restored():
    """A matte scene whose brightest observations are clipped comes out as it was, apart from the
    exposure.
    """
    generator = seeded(5)
    _, directions = scene(lights=12)
    normals = normalize(torch.rand(400, 3, generator=generator) + 0.3, dim=1)
    radiance = normals @ directions.T * torch.rand(400, 1, generator=generator)
    config = replace(PLAIN, saturated_share=1.0)
    observations, *_ = photograph_scene(radiance, directions, config, seeded(2))
    assert observations.max() > 1.02
    ratio = observations / radiance
    assert ratio.std() < 0.03 * ratio.mean()


@pytest.fixture
def bumpy_set(tmp_path):
    """Two matte scenes of 14 x 14 pixels, a smooth normal each, whose pixels are disturbed one by
    one.
    """
    writer = PixelSetWriter(tmp_path / "bumpy")
    for index in range(2):
        rng = np.random.default_rng(index)
        lights = rng.normal((0, 0, 2), 1, (9, 3))
        lights[:, 2] = np.abs(lights[:, 2]) + 0.5
        lights = unit(lights).astype(np.float32)
        normals = unit(np.tile(np.float32((0.28 * index, 0, 0.96)), (196, 1)))
        observations = (normals @ lights.T).clip(0) * rng.uniform(0.5, 1.5, (196, 9))
        mask = np.ones((14, 14), np.bool_)
        writer.add(
            f"s{index}",
            f"s{index}",
            "a test",
            {},
            Pixels(np.float32(observations), normals, lights, mask),
        )
    return writer.finish()


@pytest.fixture
def refining(tiny, bumpy_set, monkeypatch):
    monkeypatch.setattr(tasks, "VALIDATION_SCENES", 2)
    monkeypatch.setattr(refinement, "ENGRAVED_SHARE", 0.0)
    monkeypatch.setattr(refinement, "BACKGROUND_SHARE", 0.0)
    monkeypatch.setattr(refinement, "ENLARGED_SHARE", 0.0)  # interpolated noise looks blurred
    return replace(
        tiny,
        network=replace(tiny.network, error_head=True, refines=True),
        sources={str(bumpy_set.folder): 1.0},
        pixels=replace(tiny.pixels, optics_share=0.0),
        updates="refine_net",
        first_captures=3,
        batch_size=2,
        shards=1,
        steps=90,
        learning_rate=1e-3,
        average_decay=0.0,
    )


@pytest.mark.usefixtures("no_pictures")
def test_the_refinement_net_learns_to_smooth_and_nothing_else_learns(refining, tmp_path):
    trainer = Trainer(refining, tmp_path / "run", CPU)
    before = {name: tensor.clone() for name, tensor in trainer.network.state_dict().items()}
    first_deg = trainer.task.validation_deg(trainer.average, bfloat16=False)
    assert trainer.run().validation_deg < 0.9 * first_deg
    after = load_weights(tmp_path / "run" / WEIGHTS).network.state_dict()
    changed = {name for name in before if not torch.equal(after[name].half(), before[name].half())}
    assert changed and all(name.startswith("refine_net.") for name in changed)


@pytest.mark.usefixtures("no_pictures")
def test_a_second_refinement_net_follows_one_that_is_trained(refining, tiny, tmp_path):
    Trainer(replace(refining, steps=5), tmp_path / "first", CPU).run()
    start_from = str(tmp_path / "first" / WEIGHTS)
    twice = replace(
        refining,
        network=replace(refining.network, refines_twice=True),
        start_from=start_from,
        steps=3,
    )
    second = Trainer(twice, tmp_path / "second", CPU)
    first = load_weights(tmp_path / "first" / WEIGHTS).network.refine_net
    assert torch.equal(second.network.refine_net.out.weight, first.out.weight)
    second.run()
    found = load_weights(tmp_path / "second" / WEIGHTS).network.refine_net
    assert found.again.out.weight.any()
    assert not torch.equal(found.out.weight, first.out.weight), "both learn together"
    with refuses("with refines_twice = True, the run's has False", ModelError):
        Trainer(
            replace(refining, start_from=str(tmp_path / "second" / WEIGHTS)),
            tmp_path / "third",
            CPU,
        )
    pixelwise = replace(tiny, start_from=str(tmp_path / "second" / WEIGHTS))
    assert Trainer(pixelwise, tmp_path / "alone", CPU).network.refine_net is None
    save_weights(
        SplineNet(replace(refining.network, refines=False)), tmp_path / "without.safetensors"
    )
    with refuses("no refinement net", ModelError):
        Trainer(
            replace(twice, start_from=str(tmp_path / "without.safetensors")), tmp_path / "run", CPU
        )


def test_the_preset_continues_the_weights_that_it_starts_from():
    refine = PRESETS["refine"]
    assert resolve_weights(refine.start_from).network.config == refine.network


def network_of(config):
    torch.manual_seed(0)
    return SplineNet(config.network)


def pool_of(bumpy_set, refining, seed):
    scenes = [(bumpy_set, bumpy_set.entries, 1.0)]
    return ScenePool(scenes, network_of(refining), refining.pixels, seed)


def test_captures_of_a_pool(refining, bumpy_set, tmp_path):
    pool = pool_of(bumpy_set, refining, 1)
    one, again = (pool_of(bumpy_set, refining, 1).photograph(0) for _ in range(2))
    other = pool_of(bumpy_set, refining, 2)
    assert one.features.shape == (FEATURE_CHANNELS, 26, 26), "with the dark margin"
    assert torch.equal(one.features, again.features)
    assert not torch.equal(one.features, other.photograph(0).features)
    assert pool.sha256() == pool_of(bumpy_set, refining, 1).sha256() != other.sha256()
    drawn = CaptureFolder(pool, tmp_path, 1).draw(3, seeded(0))
    # A turn changes no angle between estimate and truth, and so no loss before refinement.
    assert drawn.normals.shape == (3, 3, 26, 26)
    network = network_of(refining)
    straight = refinement_losses(network, stack_maps([one])).before
    assert_close(refinement_losses(network, drawn).before, straight, atol=1e-3, rtol=1e-3)


def test_stored_captures(refining, bumpy_set, tmp_path):
    captures = CaptureFolder(pool_of(bumpy_set, refining, 1), tmp_path, 2)
    first, second = files = sorted(captures.folder.iterdir())
    content = first.read_bytes()
    changed = content[:-1] + bytes([content[-1] ^ 1])
    for damaged in (content[:-9], changed, second.read_bytes()[:0]):
        first.write_bytes(damaged)
        with refuses("Remove this file", ModelError):
            captures.draw(9, seeded(0))
    first.unlink()
    unfinished = captures.folder / f".x{UNFINISHED}"
    unfinished.touch()
    CaptureFolder(captures.pool, tmp_path, 2)
    assert sorted(captures.folder.iterdir()) == files, "photographed again"
    assert first.read_bytes() == content


@pytest.mark.usefixtures("no_pictures")
def test_a_run_that_continues_ends_as_without_the_interruption(refining, tmp_path):
    """Also if the captures were deleted. It began with the newest captures alone."""
    whole, rest = (tmp_path / name / WEIGHTS for name in ("whole", "rest"))
    refining, steps = replace(refining, schedule="stepped"), 2 * STEPS_PER_CAPTURE + 1
    Trainer(replace(refining, steps=steps), whole.parent, CPU).run()
    Trainer(replace(refining, steps=STEPS_PER_CAPTURE + 1), rest.parent, CPU).run()
    shutil.rmtree(rest.parent / CAPTURES)
    Trainer(replace(refining, steps=steps), rest.parent, CPU, resume=True).run()
    assert whole.read_bytes() == rest.read_bytes()


def test_generated_pixels_are_no_scenes(refining, tmp_path):
    with refuses("rendered scenes", UsageError):
        Trainer(replace(refining, sources={"generator": 1.0}), tmp_path, CPU)


def test_the_loss_of_detail_does_not_count_what_turns_all_normals(refining):
    """A plate in steps, all of it tilted as under wrong lights, or with its steps smoothed. The net
    changes nothing.
    """
    network = network_of(refining)
    slopes = torch.zeros(2, 24, 24)
    slopes[0, :, 12:] = 0.5

    def unit_of(slopes):
        return normalize(torch.cat((-slopes, torch.ones(1, 24, 24))), dim=0)

    def losses_of(estimate):
        features = torch.zeros(1, FEATURE_CHANNELS, 24, 24)
        features[0, :3] = estimate
        maps = SceneMaps(features, unit_of(slopes)[None], torch.ones(1, 1, 24, 24))
        return [
            refinement_losses(network, maps, detail_weight=weight).total.item()
            for weight in (0.0, 10.0)
        ]

    tilted, smoothed = (
        unit_of(slopes + 0.3),
        unit_of(torch.nn.functional.avg_pool2d(slopes, 5, 1, 2)),
    )
    for estimate, most, least in ((tilted, 0.4, 0.0), (smoothed, 9.0, 0.5)):
        without, with_detail = losses_of(estimate)
        assert least < (with_detail - without) / without < most
