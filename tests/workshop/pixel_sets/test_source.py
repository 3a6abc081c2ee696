"""Batches from a pixel set contain the stored pixels, under drawn lights, and dense maps fill only
gaps.
"""

from dataclasses import replace

import numpy as np
import torch
from pytest import approx
from torch.testing import assert_close

from distributions import FAULTLESS, seeded
from scenes import parametrize
from splinecli.maths.observation_map import cell_directions
from splinecli.workshop.pixel_sets.source import (
    PixelSetSource,
    SampledPixels,
    fill_gaps,
)
from splinecli.workshop.synthesis.batches import CaptureConfig

PLAIN = CaptureConfig(**FAULTLESS, min_lights=5, max_lights=10, usual_lights=8, ambient_share=0.0)


def source_of(pixel_set, config=PLAIN, seed=0):
    return PixelSetSource(pixel_set, pixel_set.entries, config, seeded(seed))


@parametrize("dtype", [np.float32, np.float16])
def test_without_faults_observations_are_the_stored_ones(make_set, dtype):
    pixel_set = make_set(dtype=dtype)
    batch = source_of(pixel_set).draw(200)
    stored = {entry.name: pixel_set.load(entry) for entry in pixel_set.entries}
    seen = set()
    rows = {
        normal.tobytes(): (name, row)
        for name in stored
        for row, normal in enumerate(stored[name].normals)
    }
    for pixel, normal in enumerate(batch.truth.normals.numpy()):
        name, row = rows[normal.tobytes()]
        seen.add(name)
        valid = batch.valid[pixel].numpy()
        used = set()
        for direction, observed in zip(
            batch.light_directions[pixel].numpy()[valid],
            batch.observations[pixel].numpy()[valid],
            strict=True,
        ):
            distance = np.abs(stored[name].light_directions - direction).max(axis=1)
            light = int(distance.argmin())
            assert distance[light] < 1e-6  # normalised once more
            used.add(light)
            expected = float(stored[name].observations[row, light]) * batch.exposure[pixel].item()
            assert observed == approx(expected, rel=1e-6, abs=1e-9)
        assert len(used) == valid.sum()  # no light twice
        assert (batch.observations[pixel].numpy()[~valid] == 0).all()
    assert seen == {"a", "b", "c"}


def test_all_pixels_have_the_same_probability(make_set):
    pixel_set = make_set()
    normals = source_of(pixel_set).draw(9000).truth.normals.numpy()
    of_b = (normals[:, None] == pixel_set.load(pixel_set.entries[1]).normals).all(axis=2)
    # 30 pixels of 90: a third, and a ninetieth each. Within four standard deviations of the
    # binomial.
    assert of_b.any(axis=1).sum() == approx(3000, abs=4 * np.sqrt(9000 * 2 / 9))
    assert of_b.sum(axis=0) == approx(np.full(30, 100), abs=4 * np.sqrt(100))


def test_a_set_with_fewer_lights_than_asked_for_gives_all_it_has(make_set):
    pixel_set = make_set(entries=[("a", "one", 20, 6), ("b", "two", 20, 12)])
    config = replace(PLAIN, min_lights=20, max_lights=20, usual_lights=20)
    batch = source_of(pixel_set, config).draw(100)
    assert set(batch.valid.sum(dim=1).tolist()) == {6, 12}
    few = batch.valid.sum(dim=1) == 6
    normals = pixel_set.load(pixel_set.entries[0]).normals
    assert all((normals == normal).all(axis=1).any() for normal in batch.truth.normals[few].numpy())


def test_pixels_of_a_capture_are_of_one_entry_under_the_same_lights(make_set):
    pixel_set = make_set()
    source = source_of(pixel_set, replace(PLAIN, capture_pixels=10))
    names = {
        n.tobytes(): entry.name
        for entry in pixel_set.entries
        for n in pixel_set.load(entry).normals
    }
    entries = []
    for _ in range(40):
        batch = source.draw(100)
        assert batch.captures == 10
        for capture in range(10):
            rows = slice(capture, None, 10)
            (name,) = {names[normal.tobytes()] for normal in batch.truth.normals[rows].numpy()}
            entries.append(name)
            assert len(batch.light_directions[rows].unique(dim=0)) == 1
            assert len(batch.valid[rows].unique(dim=0)) == 1
        radiance = batch.observations / batch.exposure
        stored = {
            v
            for e in pixel_set.entries
            for v in pixel_set.load(e).observations.round(4).ravel().tolist()
        }
        unclipped = (batch.observations < 0.99) & batch.valid
        assert {round(v, 4) for v in radiance[unclipped].tolist()} <= {round(v, 4) for v in stored}
    # An entry has as much weight as its pixels: 40, 30 and 20.
    shares = [entries.count(name) / len(entries) for name in "abc"]
    assert shares == approx([4 / 9, 3 / 9, 2 / 9], abs=0.1)


def analytic_scene(pixels=6):
    """Matte pixels under lights at the centres of a third of the cells."""
    directions, inside = cell_directions()
    lights = directions[inside][::3].expand(pixels, -1, 3)
    normals = torch.nn.functional.normalize(torch.rand(pixels, 3, generator=seeded()) + 0.1, dim=1)
    radiance = (lights @ normals[..., None])[..., 0].clamp(min=0)
    return SampledPixels(normals, radiance, lights, torch.ones_like(radiance) > 0), normals


@parametrize("quarter_turns", [0, 1, 2, 3])
def test_dense_truth_is_the_analytic_map_after_a_rotation(quarter_turns):
    scene, normals = analytic_scene()
    angle = torch.tensor(quarter_turns * torch.pi / 2).expand(6)
    turned = scene.rotate(angle.cos().round(), angle.sin().round())
    dense = turned.dense_truth(32)
    assert (dense.known.sum((1, 2, 3)) == scene.radiance.shape[1]).all()
    x, y, z = normals.unbind(1)
    for _ in range(quarter_turns):
        x, y = -y, x
    rotated = torch.stack((x, y, z), dim=1)
    assert_close(turned.normals, rotated)
    analytic = (cell_directions()[0] @ rotated.T).permute(2, 0, 1)[:, None].clamp(min=0)
    assert_close(dense.values * dense.known, analytic * dense.known)
    # Interpolated between cells of 1 / 16, where n . l has a slope of about 1; along the rim, where
    # l_z falls steeply and all neighbours lie further in, errors are larger.
    filled = dense.filled - dense.known
    error = ((dense.values - analytic) * filled).abs()
    assert error.sum() / filled.sum() < 0.02
    assert error[..., cell_directions()[0][..., 2] > 0.5].max() < 2 / 16


def test_gaps_are_filled_between_lights_and_not_beside_them():
    _, inside = cell_directions()
    known, values = torch.zeros(1, 1, 32, 32), torch.zeros(1, 1, 32, 32)
    for row, column, value in ((16, 10, 0.2), (16, 12, 0.6), (5, 20, 0.9)):
        known[0, 0, row, column], values[0, 0, row, column] = 1, value
    dense = fill_gaps(values, known, inside)
    # One gap is halfway between two lights. A single light fills none of its neighbours.
    assert dense.filled.sum() == 4
    assert dense.values[0, 0, 16, 11].item() == approx(0.4)
    assert torch.equal(dense.known, known)
