"""Where training pixels come from: what is drawn is what is stored, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from splinecli.errors import InputError
from splinecli.observation_map import cell_directions
from splinecli.pixel_sets.store import Entry, PixelSet
from splinecli.synthesis.batches import CaptureConfig, PixelBatch
from splinecli.synthesis.pixels import PixelGenerator
from splinecli.training import sources
from splinecli.training.config import GENERATOR, TrainingConfig
from splinecli.training.sources import (
    FILL_STEPS,
    MixedSource,
    PixelSetSource,
    SampledScene,
    fill_gaps,
    hold_back,
    open_sources,
)

FAULTLESS = CaptureConfig(
    min_lights=5, max_lights=10, usual_lights=8, light_direction_error_share=0.0,
    light_intensity_error_share=0.0, saturated_share=0.0, sensor_noise=False, eight_bit_share=0.0,
)  # fmt: skip
MakeSet = Callable[..., PixelSet]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def source_of(pixel_set: PixelSet, config: CaptureConfig = FAULTLESS, seed: int = 0) -> PixelSetSource:
    return PixelSetSource(pixel_set, pixel_set.entries, config, seeded(seed))


def assert_same(one: PixelBatch, other: PixelBatch) -> None:
    for name in ("observations", "light_directions", "valid", "exposure"):
        assert torch.equal(getattr(one, name), getattr(other, name))
    assert torch.equal(one.scene.normals, other.scene.normals)


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_without_faults_observations_are_the_stored_ones(make_set: MakeSet, dtype: type) -> None:
    pixel_set = make_set(dtype=dtype)
    batch = source_of(pixel_set).draw(200)
    stored = {entry.name: pixel_set.load(entry) for entry in pixel_set.entries}
    seen = set()
    for pixel, normal in enumerate(batch.scene.normals.numpy()):
        name, row = next(
            (name, int(np.flatnonzero((pixels.normals == normal).all(axis=1))[0]))
            for name, pixels in stored.items()
            if (pixels.normals == normal).all(axis=1).any()
        )
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
            assert observed == pytest.approx(expected, rel=1e-6, abs=1e-9)
        assert len(used) == valid.sum()  # no light twice
        assert (batch.observations[pixel].numpy()[~valid] == 0).all()
    assert seen == {"a", "b", "c"}


def test_pixels_are_alike_likely(make_set: MakeSet) -> None:
    pixel_set = make_set()
    normals = source_of(pixel_set).draw(9000).scene.normals.numpy()
    of_b = (normals[:, None] == pixel_set.load(pixel_set.entries[1]).normals).all(axis=2)
    # 30 pixels of 90: a third, and a ninetieth each. Within four standard deviations of the binomial.
    assert of_b.any(axis=1).sum() == pytest.approx(3000, abs=4 * np.sqrt(9000 * 2 / 9))
    assert of_b.sum(axis=0) == pytest.approx(np.full(30, 100), abs=4 * np.sqrt(100))


def test_as_many_lights_as_configured(make_set: MakeSet) -> None:
    batch = source_of(make_set()).draw(400)
    counts = batch.valid.sum(dim=1)
    assert counts.min() == 5
    assert counts.max() == 10
    assert batch.valid.shape[1] == 10
    usual = replace(FAULTLESS, min_lights=8, max_lights=8)
    assert (source_of(make_set("other"), usual).draw(50).valid.sum(dim=1) == 8).all()


def test_a_set_with_fewer_lights_than_asked_for_gives_all_it_has(make_set: MakeSet) -> None:
    pixel_set = make_set(entries=[("a", "one", 20, 6), ("b", "two", 20, 12)])
    config = replace(FAULTLESS, min_lights=20, max_lights=20, usual_lights=20)
    batch = source_of(pixel_set, config).draw(100)
    assert set(batch.valid.sum(dim=1).tolist()) == {6, 12}
    few = batch.valid.sum(dim=1) == 6
    normals = pixel_set.load(pixel_set.entries[0]).normals
    assert all((normals == normal).all(axis=1).any() for normal in batch.scene.normals[few].numpy())


def test_lights_lie_within_a_random_angle_and_then_closest_to_it(make_set: MakeSet) -> None:
    # One pixel's lights: none of those left out beyond the angle is nearer the axis than one taken beyond it.
    pixel_set = make_set(entries=[("a", "one", 50, 200)])
    config = replace(FAULTLESS, min_lights=10, max_lights=10, usual_lights=10)
    batch = source_of(pixel_set, config).draw(600)
    largest = batch.light_directions[..., 2].acos().rad2deg().amax(dim=1)
    # Of all 200 lights, 10 reach out to 70 or so nearly always; of a random cone only sometimes.
    assert 0.15 < (largest < 50).float().mean() < 0.6
    zeniths = np.sort(np.degrees(np.arccos(pixel_set.load(pixel_set.entries[0]).light_directions[:, 2])))
    assert largest.min() >= zeniths[9] - 0.01  # ten lights reach at least as far as the ten innermost


def test_pixels_with_fewer_lights_than_others_know_no_more_cells(make_set: MakeSet) -> None:
    scene = source_of(make_set()).draw(300).scene
    assert isinstance(scene, SampledScene)
    assert set(scene.known.sum(dim=1).tolist()) == {12, 25, 30}
    dense = scene.dense_truth(32)
    assert (dense.known.sum((1, 2, 3)) <= scene.known.sum(dim=1)).all()
    assert (dense.filled >= dense.known).all()


def analytic_scene(pixels: int = 6) -> tuple[SampledScene, torch.Tensor]:
    """Matte pixels under lights at the centres of a third of the cells."""
    directions, inside = cell_directions()
    lights = directions[inside][::3].expand(pixels, -1, 3)
    normals = torch.nn.functional.normalize(torch.rand(pixels, 3, generator=seeded()) + 0.1, dim=1)
    radiance = (lights @ normals[..., None])[..., 0].clamp(min=0)
    return SampledScene(normals, radiance, lights, torch.ones_like(radiance) > 0), normals


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_dense_truth_is_the_analytic_map_after_a_rotation(quarter_turns: int) -> None:
    scene, normals = analytic_scene()
    angle = torch.tensor(quarter_turns * torch.pi / 2).expand(6)
    turned = scene.rotate(angle.cos().round(), angle.sin().round())
    dense = turned.dense_truth(32)
    assert (dense.known.sum((1, 2, 3)) == scene.radiance.shape[1]).all()
    x, y, z = normals.unbind(1)
    for _ in range(quarter_turns):
        x, y = -y, x
    rotated = torch.stack((x, y, z), dim=1)
    torch.testing.assert_close(turned.normals, rotated)
    analytic = (cell_directions()[0] @ rotated.T).permute(2, 0, 1)[:, None].clamp(min=0)
    torch.testing.assert_close(dense.values * dense.known, analytic * dense.known)
    # Interpolated between cells of 1 / 16, where n . l has a slope of about 1; along the rim, where l_z falls
    # steeply and all neighbours lie further in, errors are larger.
    filled = dense.filled - dense.known
    error = ((dense.values - analytic) * filled).abs()
    assert error.sum() / filled.sum() < 0.02
    assert error[..., cell_directions()[0][..., 2] > 0.5].max() < 2 / 16


def test_any_rotation_puts_each_light_into_its_cell() -> None:
    scene, _ = analytic_scene(3)
    known = torch.rand(scene.known.shape, generator=seeded(1)) < 0.3
    scene = SampledScene(scene.normals, scene.radiance, scene.light_directions, known)
    angle = torch.tensor([0.3, -1.1, 2.5])
    dense = scene.rotate(angle.cos(), angle.sin()).dense_truth(32)
    for pixel in range(3):
        found: dict[tuple[int, int], list[float]] = {}
        cosine, sine = angle[pixel].cos().item(), angle[pixel].sin().item()
        for light in known[pixel].nonzero()[:, 0]:
            x, y, _ = scene.light_directions[pixel, light].tolist()
            column = int((cosine * x - sine * y + 1) * 16)
            row = int((1 - (sine * x + cosine * y)) * 16)
            found.setdefault((row, column), []).append(scene.radiance[pixel, light].item())
        inside = cell_directions()[1]
        expected = {cell: np.mean(values) for cell, values in found.items() if inside[cell]}
        assert {tuple(cell) for cell in dense.known[pixel, 0].nonzero().tolist()} == set(expected)
        for cell, value in expected.items():
            assert dense.values[pixel, 0][cell].item() == pytest.approx(value, abs=1e-6)


def test_linear_maps_are_filled_about_right_and_known_cells_stay() -> None:
    directions, inside = cell_directions()
    linear = (0.5 + 0.3 * directions[..., 0] - 0.2 * directions[..., 1])[None, None]
    disc = inside.float()[None, None]
    known = (torch.rand(1, 1, 32, 32, generator=seeded()) < 0.4).float() * disc
    dense = fill_gaps(linear * known, known, inside)
    assert torch.equal(dense.known, known)
    assert torch.equal(dense.values * known, linear * known)
    # All but the rim, whose cells have neighbours on one side alone.
    within = disc * (directions[..., 2] > 0.35)
    assert (dense.filled * within).sum() > 0.85 * within.sum()
    assert (dense.filled * (1 - disc)).sum() == 0
    # The slope along a row or column is at most 0.3 / 16 a cell, and neighbours are asked first.
    error = ((dense.values - linear) * dense.filled).abs()
    assert error.max() < 2 * 0.5 / 16
    assert error.sum() / disc.sum() < 0.3 * 0.3 / 16


def test_a_single_gap_of_a_linear_map_is_filled_exactly() -> None:
    rows, columns = torch.meshgrid(torch.arange(32.0), torch.arange(32.0), indexing="ij")
    linear = (0.01 * rows + 0.02 * columns)[None, None]
    known = torch.ones(1, 1, 32, 32)
    known[0, 0, 10, 20] = 0
    # The value of a cell that is not known plays no part.
    given = torch.where(known > 0, linear, torch.tensor(77.0))
    dense = fill_gaps(given, known, torch.ones(32, 32))
    assert dense.values[0, 0, 10, 20].item() == pytest.approx(0.1 + 0.4, rel=1e-5)


def test_gaps_are_filled_between_lights_and_not_beside_them() -> None:
    _, inside = cell_directions()
    known, values = torch.zeros(1, 1, 32, 32), torch.zeros(1, 1, 32, 32)
    for row, column, value in ((16, 10, 0.2), (16, 12, 0.6), (5, 20, 0.9)):
        known[0, 0, row, column], values[0, 0, row, column] = 1, value
    dense = fill_gaps(values, known, inside)
    # One gap lies between two lights, half way. A light alone says nothing of its neighbours.
    assert dense.filled.sum() == 4
    assert dense.values[0, 0, 16, 11].item() == pytest.approx(0.4)
    assert torch.equal(dense.known, known)


def test_nothing_is_filled_outside_the_disc_or_far_from_a_light() -> None:
    _, inside = cell_directions()
    known = torch.ones(1, 1, 32, 32)
    known[0, 0, 8:24, 8:24] = 0
    dense = fill_gaps(torch.full((1, 1, 32, 32), 0.5) * known, known * inside, inside)
    assert not dense.filled[0, 0][~inside].any()
    assert not dense.values[0, 0][~inside].any()
    middle = slice(8 + FILL_STEPS, 24 - FILL_STEPS)
    assert not dense.filled[0, 0, middle, middle].any()
    np.testing.assert_allclose(dense.values[dense.filled > 0], 0.5, rtol=1e-6)


def test_no_light_and_no_map() -> None:
    dense = fill_gaps(torch.zeros(2, 1, 16, 16), torch.zeros(2, 1, 16, 16), cell_directions(16)[1])
    assert not dense.values.any()
    assert not dense.filled.any()


class Constant:
    """Pixels whose exposure says where they are from."""

    def __init__(self, number: float, lights: int) -> None:
        self.number, self.lights = number, lights
        self.asked: list[int] = []

    def draw(self, pixels: int) -> PixelBatch:
        self.asked.append(pixels)
        lights = torch.tensor((0.0, 0.0, 1.0)).expand(pixels, self.lights, 3)
        ones = torch.ones(pixels, self.lights)
        scene = SampledScene(lights[:, 0], ones, lights, ones > 0)
        return PixelBatch(ones, lights, ones > 0, scene, torch.full((pixels, 1), self.number))


def test_a_mixture_keeps_its_weights() -> None:
    parts = [Constant(1.0, 3), Constant(2.0, 5), Constant(3.0, 4)]
    batch = MixedSource(parts, (1.0, 6.0, 3.0), seeded()).draw(8000)
    assert batch.observations.shape == (8000, 5)
    for number, share in ((1.0, 0.1), (2.0, 0.6), (3.0, 0.3)):
        found = (batch.exposure == number).sum().item()
        # Four standard deviations of the binomial.
        assert found == pytest.approx(8000 * share, abs=4 * np.sqrt(8000 * share * (1 - share)))
    # Those with fewer lights have further ones that are not valid.
    assert torch.equal(batch.valid.sum(dim=1), torch.tensor([0, 3, 5, 4])[batch.exposure[:, 0].long()])
    assert not batch.observations[~batch.valid].any()


def test_a_mixture_is_its_seed_s_and_never_asks_for_no_pixel() -> None:
    def exposures(seed: int) -> torch.Tensor:
        parts = [Constant(1.0, 3), Constant(2.0, 3)]
        mixed = MixedSource(parts, (0.02, 1.0), seeded(seed))
        drawn = torch.cat([mixed.draw(4).exposure for _ in range(40)])
        assert 0 not in parts[0].asked
        return drawn

    assert torch.equal(exposures(3), exposures(3))
    assert not torch.equal(exposures(3), exposures(4))


def entries_of(*scenes: str) -> list[Entry]:
    return [Entry(f"e{i}", scene, "", {}, 1, 3, {}) for i, scene in enumerate(scenes)]


@pytest.mark.parametrize(
    ("scenes", "share", "held_scenes"),
    [
        (("a", "a", "b", "b", "c", "c"), 0.1, 1),
        (("a", "b", "a", "b"), 0.1, 1),
        (tuple("abcdefghij") * 3, 0.2, 2),
        (("a", "b", "c"), 1.0, 2),
        (("a", "a", "a"), 0.5, 0),
        (("a", "b", "c"), 0.0, 0),
    ],
)
def test_scenes_are_held_back_whole_and_never_all(
    scenes: tuple[str, ...], share: float, held_scenes: int
) -> None:
    entries = entries_of(*scenes)
    training, validation = hold_back(entries, share)
    held = {entry.scene for entry in validation}
    assert len(held) == held_scenes
    assert {entry.scene for entry in training} == set(scenes) - held
    assert sorted(entry.name for entry in training + validation) == sorted(entry.name for entry in entries)
    # Neither the order nor further scenes, at the same share, let a held one into the training.
    again = hold_back(entries[::-1], share)[1]
    assert {entry.scene for entry in again} == held


def test_a_held_scene_stays_held_when_a_set_grows() -> None:
    held = {entry.scene for entry in hold_back(entries_of(*(f"s{i}" for i in range(40))), 0.25)[1]}
    grown = {entry.scene for entry in hold_back(entries_of(*(f"s{i}" for i in range(80))), 0.25)[1]}
    assert len(held) == 10
    # Where it falls out, it does so at the edge of the share: by the hash, two halves of a set are alike.
    assert len(held & grown) >= 7


def rows_of(pixel_set: PixelSet, *names: str) -> set[tuple[float, ...]]:
    return {
        tuple(normal)
        for entry in pixel_set.entries
        if entry.name in names
        for normal in pixel_set.load(entry).normals.tolist()
    }


def normals_of(batch: PixelBatch) -> set[tuple[float, ...]]:
    return {tuple(normal) for normal in batch.scene.normals.tolist()}


def test_validation_sees_held_scenes_and_training_never_does(make_set: MakeSet, tiny: TrainingConfig) -> None:
    pixel_set = make_set(entries=[("a1", "a", 20, 20), ("b1", "b", 20, 20), ("b2", "b", 20, 20)])
    opened = open_sources(replace(tiny, sources={str(pixel_set.folder): 1.0}), seeded(1), seeded(2))
    training, validation = opened.training.draw(500), opened.validation.draw(300)
    held = {entry.name for entry in hold_back(pixel_set.entries, tiny.held_share)[1]}
    assert held in ({"a1"}, {"b1", "b2"})
    assert normals_of(training) == rows_of(pixel_set, *({"a1", "b1", "b2"} - held))
    assert normals_of(validation) == rows_of(pixel_set, *held)
    assert (validation.valid.sum(dim=1) == tiny.pixels.usual_lights).all()
    assert len(set(training.valid.sum(dim=1).tolist())) > 3


def test_a_single_scene_is_validated_on_itself(make_set: MakeSet, tiny: TrainingConfig) -> None:
    pixel_set = make_set(entries=[("a", "one", 20, 20)])
    opened = open_sources(replace(tiny, sources={str(pixel_set.folder): 1.0}), seeded(1), seeded(2))
    assert normals_of(opened.validation.draw(300)) == normals_of(opened.training.draw(300))


def test_a_set_and_the_generator_together(make_set: MakeSet, tiny: TrainingConfig) -> None:
    pixel_set = make_set()
    config = replace(tiny, sources={str(pixel_set.folder): 1.0, GENERATOR: 3.0})

    def draw(seed: int) -> tuple[PixelBatch, PixelBatch]:
        opened = open_sources(config, seeded(seed), seeded(seed + 1))
        return opened.training.draw(2000), opened.validation.draw(400)

    (training, validation), again = draw(5), draw(5)
    assert_same(training, again[0])
    assert_same(validation, again[1])
    assert not torch.equal(draw(6)[0].scene.normals, training.scene.normals)
    held = {entry.name for entry in hold_back(pixel_set.entries, config.held_share)[1]}
    stored = rows_of(pixel_set, *({"a", "b", "c"} - held))
    from_set = sum(tuple(normal) in stored for normal in training.scene.normals.tolist())
    assert from_set == pytest.approx(500, abs=4 * np.sqrt(2000 * 0.25 * 0.75))
    assert normals_of(validation) & rows_of(pixel_set, "a", "b", "c") <= rows_of(pixel_set, *held)
    # The truth of both kinds goes through the same frame.
    assert training.scene.dense_truth(32).values.shape == (2000, 1, 32, 32)


def test_a_shape_held_in_one_set_is_not_trained_on_in_another(
    make_set: MakeSet, tiny: TrainingConfig
) -> None:
    # The same three shapes under other names: what either set holds back, the other must not train on.
    one = make_set("one", entries=[("a", "a", 20, 20), ("b", "b", 20, 20), ("c", "c", 20, 20)])
    other = make_set("other", entries=[("x", "x", 20, 20), ("y", "y", 20, 20), ("z", "z", 20, 20)])
    sources = {str(one.folder): 1.0, str(other.folder): 1.0}
    opened = open_sources(replace(tiny, sources=sources), seeded(1), seeded(2))
    assert not normals_of(opened.training.draw(600)) & normals_of(opened.validation.draw(600))
    assert set(opened.sets) == set(sources)
    # Where nothing is left, it says so: here the only scene is held by the other set.
    held_first = "p" if hold_back(entries_of("p", "q"), 0.1)[1][0].scene == "p" else "q"
    order = ("p", "q") if held_first == "p" else ("q", "p")
    rest = make_set("rest", entries=[(name, name, 20, 20) for name in order])
    alone = make_set("alone", entries=[("a", "a", 20, 20)])
    with pytest.raises(InputError, match="all its scenes are held back"):
        open_sources(
            replace(tiny, sources={str(alone.folder): 1.0, str(rest.folder): 1.0}), seeded(), seeded()
        )


def test_a_set_of_one_scene_is_named(make_set: MakeSet, tiny: TrainingConfig) -> None:
    alone = make_set("alone", entries=[("a", "one", 20, 20)])
    opened = open_sources(replace(tiny, sources={str(alone.folder): 1.0}), seeded(), seeded())
    assert opened.unheld == (str(alone.folder),)


def test_sources_without_weight_are_not_opened(tiny: TrainingConfig) -> None:
    opened = open_sources(replace(tiny, sources={"/no/such/set": 0.0, GENERATOR: 1.0}), seeded(), seeded(1))
    assert isinstance(opened.training, PixelGenerator)


def test_arrays_are_let_go_without_changing_what_is_drawn(
    make_set: MakeSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixel_set = make_set()
    kept = source_of(pixel_set)
    expected = [kept.draw(50) for _ in range(6)]
    assert set(kept._observations) == {0, 1, 2}
    assert kept._touched > 300 * 65_536
    # After 60 pixels, of what is mapped around each row.
    monkeypatch.setattr(sources, "_MAPPED_BYTES", 60 * 65_536)
    freed = source_of(pixel_set)
    open_after = []
    for wanted in expected:
        assert_same(freed.draw(50), wanted)
        open_after.append(len(freed._observations))
    assert open_after == [3, 0, 3, 0, 3, 0]
    assert freed._touched == 0
