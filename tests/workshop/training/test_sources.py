"""Sources of training and validation pixels: weights of a mixture,
and scenes kept for validation.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from distributions import seeded
from scenes import parametrize, refuses
from splinecli.workshop.pixel_sets.store import Entry
from splinecli.workshop.synthesis.pixels import PixelGenerator
from splinecli.workshop.training.config import GENERATOR
from splinecli.workshop.training.tasks import open_sets, pixel_source, split_scenes


def open_sources(config, seed=0):
    """The sources of training and validation pixels."""
    opened = open_sets(config)
    return (
        pixel_source(config, opened.training, seeded(seed)),
        pixel_source(config, opened.validation, seeded(seed + 1), validates=True),
    )


def parts(batch):
    return (
        batch.observations,
        batch.light_directions,
        batch.valid,
        batch.exposure,
        batch.truth.normals,
    )


def entries_of(*scenes):
    return [Entry(f"e{i}", scene, "", {}, 1, 3, {}) for i, scene in enumerate(scenes)]


@parametrize(
    "scenes, share, n_validation",
    [
        (("a", "a", "b", "b", "c", "c"), 0.1, 1),
        (("a", "b", "a", "b"), 0.1, 1),
        (tuple("abcdefghij") * 3, 0.2, 2),
        (("a", "b", "c"), 1.0, 2),
        (("a", "a", "a"), 0.5, 0),
        (("a", "b", "c"), 0.0, 0),
    ],
)
def test_validation_takes_whole_scenes_and_never_all(scenes, share, n_validation):
    entries = entries_of(*scenes)
    training, validation = split_scenes(entries, share)
    for_validation = {entry.scene for entry in validation}
    assert len(for_validation) == n_validation
    assert {entry.scene for entry in training} == set(scenes) - for_validation
    assert sorted(entry.name for entry in training + validation) == sorted(
        entry.name for entry in entries
    )
    # The order of the entries does not matter.
    again = split_scenes(entries[::-1], share)[1]
    assert {entry.scene for entry in again} == for_validation


def rows_of(pixel_set, *names):
    return {
        tuple(normal)
        for entry in pixel_set.entries
        if entry.name in names
        for normal in pixel_set.load(entry).normals.tolist()
    }


def normals_of(batch):
    return {tuple(normal) for normal in batch.truth.normals.tolist()}


def test_training_never_draws_from_validation_scenes(make_set, tiny):
    pixel_set = make_set(entries=[("a1", "a", 20, 20), ("b1", "b", 20, 20), ("b2", "b", 20, 20)])
    source, held = open_sources(replace(tiny, sources={str(pixel_set.folder): 1.0}))
    training, validation = source.draw(500), held.draw(300)
    for_validation = {entry.name for entry in split_scenes(pixel_set.entries, tiny.held_share)[1]}
    assert for_validation in ({"a1"}, {"b1", "b2"})
    assert normals_of(training) == rows_of(pixel_set, *({"a1", "b1", "b2"} - for_validation))
    assert normals_of(validation) == rows_of(pixel_set, *for_validation)
    assert (validation.valid.sum(dim=1) == tiny.pixels.usual_lights).all()
    counts = {int(source.draw(1).valid.sum()) for _ in range(30)}
    assert len(counts) > 3


def test_a_single_scene_is_validated_on_itself(make_set, tiny):
    pixel_set = make_set(entries=[("a", "one", 20, 20)])
    source, held = open_sources(replace(tiny, sources={str(pixel_set.folder): 1.0}))
    assert normals_of(held.draw(300)) == normals_of(source.draw(300))


def test_a_set_and_the_generator_together(make_set, tiny):
    pixel_set = make_set()
    config = replace(tiny, sources={str(pixel_set.folder): 1.0, GENERATOR: 3.0})

    source, held = open_sources(config, 5)
    training, validation = [source.draw(5) for _ in range(60)], [held.draw(5) for _ in range(15)]
    again = open_sources(config, 5)[0].draw(5)
    assert all(map(torch.equal, parts(training[0]), parts(again)))
    for_validation = {entry.name for entry in split_scenes(pixel_set.entries, config.held_share)[1]}
    stored = rows_of(pixel_set, *({"a", "b", "c"} - for_validation))
    # A batch has one source. The set gives a quarter of the batches.
    from_set = [sum(normal in stored for normal in normals_of(batch)) for batch in training]
    assert all(
        count in (0, len(normals_of(batch)))
        for count, batch in zip(from_set, training, strict=True)
    )
    assert sum(count > 0 for count in from_set) == pytest.approx(
        15, abs=4 * np.sqrt(60 * 0.25 * 0.75)
    )
    found = set().union(*(normals_of(batch) for batch in validation)) & rows_of(
        pixel_set, "a", "b", "c"
    )
    assert found <= rows_of(pixel_set, *for_validation)
    # Both kinds of truth give maps of one shape.
    assert {batch.truth.dense_truth(32).values.shape for batch in training} == {(5, 1, 32, 32)}


def test_a_validation_shape_of_one_set_is_not_trained_on_in_another(make_set, tiny):
    # Both sets have the same three shapes under other names.
    one, other = (
        make_set(names, entries=[(name, name, 20, 20) for name in names])
        for names in ("abc", "xyz")
    )
    source, held = open_sources(
        replace(tiny, sources={str(one.folder): 1.0, str(other.folder): 1.0})
    )
    assert not normals_of(source.draw(600)) & normals_of(held.draw(600))
    # The only scene of "alone" is a validation scene of the other set, so nothing is left for
    # training.
    order = ("p", "q") if split_scenes(entries_of("p", "q"), 0.1)[1][0].scene == "p" else ("q", "p")
    rest = make_set("rest", entries=[(name, name, 20, 20) for name in order])
    alone = make_set("alone", entries=[("a", "a", 20, 20)])
    with refuses("all scenes of the set are used for validation"):
        open_sets(replace(tiny, sources={str(alone.folder): 1.0, str(rest.folder): 1.0}))


def test_sources_without_weight_are_not_opened(tiny):
    source, _ = open_sources(replace(tiny, sources={"/no/such/set": 0.0, GENERATOR: 1.0}))
    assert isinstance(source, PixelGenerator)
