"""The training loop: it learns, it can be stopped and taken up, and it says when it cannot go on."""

from __future__ import annotations

import csv
import itertools
import json
import math
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from splinecli.devices import choose_precision
from splinecli.errors import ModelError, OutputError
from splinecli.networks.config import NetworkConfig
from splinecli.networks.weights import load_weights
from splinecli.observation_map import cell_directions, sparse_map
from splinecli.synthesis.pixels import PixelBatch, PixelGenerator
from splinecli.training import loop
from splinecli.training.checkpoint import read_checkpoint_config
from splinecli.training.config import TrainingConfig, preset
from splinecli.training.loop import (
    CHECKPOINT,
    METRICS,
    WEIGHTS,
    Metrics,
    Trainer,
    learning_rate,
    truth_in_frame,
    validation_deg,
    validation_set,
)

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def small_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "VALIDATION_PIXELS", 64)


class OneBatch(PixelGenerator):
    """Draws the same batch again and again."""

    def __init__(self, config: TrainingConfig) -> None:
        super().__init__(config.pixels, torch.Generator().manual_seed(config.seed))
        self.batch = PixelGenerator.draw(self, config.batch_size)

    def draw(self, pixels: int) -> PixelBatch:
        return self.batch


@pytest.mark.parametrize(
    ("step", "progress", "expected"),
    [
        (0, 0.0, 1.5e-3 / 300),
        (149, 0.0, 1.5e-3 / 2),
        (299, 0.0, 1.5e-3),
        (10_000, 0.5, 1.5e-3 * 0.505),
        (10_000, 1 / 3, 1.5e-3 * (0.01 + 0.99 * 0.75)),
        (40_000, 1.0, 1.5e-5),
        (40_000, 2.0, 1.5e-5),
    ],
)
def test_cosine_schedule(step: int, progress: float, expected: float) -> None:
    config = TrainingConfig(learning_rate=1.5e-3, warmup_steps=300)
    assert learning_rate(config, step, progress) == pytest.approx(expected)
    assert learning_rate(config, step, progress) == learning_rate(config, step, progress)


@pytest.mark.parametrize(("progress", "expected"), [(0.0, 1e-4), (0.899, 1e-4), (0.9, 1e-5), (1.0, 1e-5)])
def test_the_authors_schedule(progress: float, expected: float) -> None:
    assert learning_rate(preset("paper"), 0, progress) == pytest.approx(expected)


def learn(config: TrainingConfig, folder: Path) -> list[float]:
    """Loss, angle and map error at the end of a run on one batch, over those at its start."""
    trainer = Trainer(replace(config, learning_rate=1e-2, turn_jitter_deg=0.0), folder, CPU)
    trainer.pixels = OneBatch(config)
    results = torch.stack([trainer.step() for _ in range(config.steps)])
    shares: list[float] = (results[-5:].mean(dim=0) / results[:3].mean(dim=0)).tolist()
    return shares


@pytest.mark.parametrize("size", [16, 32])
def test_normals_of_one_batch_are_learnt_by_heart(tiny: TrainingConfig, tmp_path: Path, size: int) -> None:
    loss, angle, _ = learn(replace(tiny, network=replace(tiny.network, map_size=size), steps=200), tmp_path)
    assert angle < 0.4
    # The maps of 16 pixels are more than so few channels can hold.
    assert loss < 0.7


def test_the_dense_map_of_one_pixel_is_learnt_by_heart(tiny: TrainingConfig, tmp_path: Path) -> None:
    config = replace(
        tiny, network=replace(tiny.network, width=32), batch_size=1, angle_weight=0.0, steps=200, seed=4
    )
    _, angle, on_map = learn(config, tmp_path)
    assert on_map < 0.5
    # The normals are not asked for, so they stay where they were.
    assert angle == pytest.approx(1, abs=0.1)


def losses(trainer: Trainer, steps: int) -> list[float]:
    return [trainer.step()[0].item() for _ in range(steps)]


def test_a_run_taken_up_goes_on_as_if_never_stopped(tiny: TrainingConfig, tmp_path: Path) -> None:
    whole = Trainer(tiny, tmp_path / "whole", CPU)
    expected = losses(whole, 6)
    first = Trainer(tiny, tmp_path / "halves", CPU)
    assert losses(first, 3) == expected[:3]
    first.save()
    second = Trainer(
        read_checkpoint_config(tmp_path / "halves" / CHECKPOINT), tmp_path / "halves", CPU, resume=True
    )
    assert second.clock == first.clock
    assert losses(second, 3) == pytest.approx(expected[3:], rel=1e-6)
    for network in ("network", "average"):
        for name, tensor in getattr(whole, network).state_dict().items():
            torch.testing.assert_close(
                getattr(second, network).state_dict()[name], tensor, rtol=1e-5, atol=1e-7
            )


def test_dropout_is_the_same_in_every_run_of_a_seed(tiny: TrainingConfig, tmp_path: Path) -> None:
    config = replace(tiny, network=NetworkConfig(size="paper", map_size=32), batch_size=2)
    one, other = Trainer(config, tmp_path / "one", CPU), Trainer(config, tmp_path / "other", CPU)
    first = one.step()[0]
    torch.rand(1000)  # somebody else draws from the global generator in between
    assert torch.equal(other.step()[0], first)


def test_a_folder_that_holds_a_run_is_left_alone(tiny: TrainingConfig, tmp_path: Path) -> None:
    Trainer(tiny, tmp_path, CPU).save()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(OutputError, match="holds a run already"):
        Trainer(replace(tiny, steps=9), tmp_path, CPU)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_no_run_to_take_up(tiny: TrainingConfig, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such file"):
        Trainer(tiny, tmp_path, CPU, resume=True)


def test_a_checkpoint_of_another_network(tiny: TrainingConfig, tmp_path: Path) -> None:
    Trainer(tiny, tmp_path, CPU).save()
    with pytest.raises(ModelError, match="do not fit the configuration"):
        Trainer(replace(tiny, network=replace(tiny.network, width=10)), tmp_path, CPU, resume=True)


def read_metrics(folder: Path) -> list[dict[str, str]]:
    with (folder / METRICS).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_run_writes_its_files(
    tiny: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "REPORT_STEPS", 4)
    seen: list[tuple[float, Metrics]] = []
    trainer = Trainer(replace(tiny, steps=10), tmp_path, CPU)
    last = trainer.run(lambda progress, metrics: seen.append((progress, metrics)))
    assert sorted(path.name for path in tmp_path.iterdir()) == [CHECKPOINT, "config.json", METRICS, WEIGHTS]
    assert [(progress, metrics.step) for progress, metrics in seen] == [(0.4, 4), (0.8, 8), (1.0, 10)]
    assert seen[-1][1] == last
    rows = read_metrics(tmp_path)
    assert list(rows[0]) == [field.name for field in fields(Metrics)]
    assert [row["step"] for row in rows] == ["4", "8", "10"]
    assert [row["pixels"] for row in rows] == ["64", "128", "160"]
    # Validated when saved: here at the end alone, on the averaged weights that the weight file holds.
    assert [bool(row["validation_deg"]) for row in rows] == [False, False, True]
    assert last.validation_deg is not None
    loaded = load_weights(tmp_path / WEIGHTS).network
    again = validation_deg(loaded, validation_set(trainer.config, CPU))
    assert again == pytest.approx(last.validation_deg, abs=0.05)  # float16
    assert float(rows[-1]["loss"]) == pytest.approx(last.loss, rel=1e-5)
    assert TrainingConfig.from_dict(json.loads((tmp_path / "config.json").read_text())) == trainer.config


def test_metrics_are_means_over_the_steps(tiny: TrainingConfig, tmp_path: Path) -> None:
    expected = torch.stack([Trainer(tiny, tmp_path / "a", CPU).step() for _ in range(1)]).mean(dim=0)
    last = Trainer(replace(tiny, steps=1), tmp_path / "b", CPU).run()
    assert (last.loss, last.angle_deg, last.map_error) == pytest.approx(expected.tolist(), rel=1e-6)
    steps = Trainer(tiny, tmp_path / "c", CPU)
    means = torch.stack([steps.step() for _ in range(tiny.steps)]).mean(dim=0)
    last = Trainer(tiny, tmp_path / "d", CPU).run()
    assert (last.loss, last.angle_deg, last.map_error) == pytest.approx(means.tolist(), rel=1e-5)


def test_a_finished_run_can_be_lengthened_but_not_run_again(tiny: TrainingConfig, tmp_path: Path) -> None:
    Trainer(tiny, tmp_path, CPU).run()
    with pytest.raises(ModelError, match="the run is at its end already"):
        Trainer(tiny, tmp_path, CPU, resume=True).run()
    longer = Trainer(replace(tiny, steps=9), tmp_path, CPU, resume=True)
    assert longer.run().step == 9
    assert [row["step"] for row in read_metrics(tmp_path)] == ["6", "9"]


def test_lines_after_the_last_checkpoint_are_written_once(tiny: TrainingConfig, tmp_path: Path) -> None:
    Trainer(tiny, tmp_path, CPU).run()
    with (tmp_path / METRICS).open("a") as file:
        file.write("8,128,0.1,0.001,0.5,9.0,0.1,\n10,160,0.1,0.0")  # the run was killed here
    Trainer(replace(tiny, steps=10), tmp_path, CPU, resume=True).run()
    assert [row["step"] for row in read_metrics(tmp_path)] == ["6", "10"]


def test_metrics_of_a_run_without_checkpoint_are_not_mixed_in(tiny: TrainingConfig, tmp_path: Path) -> None:
    (tmp_path / METRICS).write_text("step\n50\n")
    Trainer(tiny, tmp_path, CPU).run()
    assert [row["step"] for row in read_metrics(tmp_path)] == ["6"]


def test_minutes_bound_a_run(tiny: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A clock that moves by 0.05 s each time it is read: the machine's own speed is not what is tested.
    readings = itertools.count()
    monkeypatch.setattr("splinecli.training.loop.time.monotonic", lambda: next(readings) * 0.05)
    trainer = Trainer(replace(tiny, steps=1, minutes=0.01), tmp_path, CPU)
    trainer.clock.seconds = 0.3
    assert trainer.progress == pytest.approx(0.5)
    last = trainer.run()
    assert last.step > 1
    assert trainer.clock.seconds >= 0.6


def test_a_loss_that_is_not_finite_ends_the_run(tiny: TrainingConfig, tmp_path: Path) -> None:
    trainer = Trainer(tiny, tmp_path, CPU)
    trainer.step()
    with torch.no_grad():
        next(trainer.network.parameters()).fill_(torch.nan)
    with pytest.raises(ModelError, match=r"the loss is nan at step 1\. Lower the learning rate\."):
        trainer.run()


def test_validation_never_disturbs_training(tiny: TrainingConfig, tmp_path: Path) -> None:
    plain, checked = Trainer(tiny, tmp_path / "a", CPU), Trainer(tiny, tmp_path / "b", CPU)
    expected = losses(plain, 3)
    found = []
    for _ in range(3):
        validation_deg(checked.average, validation_set(tiny, CPU))
        found += losses(checked, 1)
    assert found == expected


def test_validation_is_the_mean_angle_to_the_truth(tiny: TrainingConfig, tmp_path: Path) -> None:
    network, batch = Trainer(tiny, tmp_path, CPU).network.eval(), validation_set(tiny, CPU)
    assert (batch.valid.sum(dim=1) == tiny.pixels.usual_lights).all()
    with torch.no_grad():
        normals = network(batch.observations, batch.light_directions, batch.valid)
    cosine = (normals.double() * batch.scene.normals).sum(dim=1).clamp(-1, 1)
    assert validation_deg(network, batch) == pytest.approx(cosine.acos().rad2deg().mean().item(), abs=1e-3)


def test_bfloat16_only_where_the_device_has_it(tiny: TrainingConfig, tmp_path: Path) -> None:
    config = replace(tiny, precision="bfloat16")
    assert Trainer(config, tmp_path / "a", CPU).bfloat16 == (choose_precision("auto", CPU) == "bfloat16")
    assert not Trainer(tiny, tmp_path / "b", CPU).bfloat16


@pytest.mark.parametrize("mirror", [False, True])
def test_truth_agrees_with_what_the_network_sees(tiny: TrainingConfig, tmp_path: Path, mirror: bool) -> None:
    # Without a camera's faults, the true dense map at a light in a cell's centre is the sparse map there.
    network = Trainer(tiny, tmp_path, CPU).network
    batch = PixelGenerator(tiny.pixels, torch.Generator().manual_seed(0)).draw(40)
    directions, inside = cell_directions()
    lights = directions[inside][3::29]
    observations = batch.scene.radiance(lights)
    seen = PixelBatch(observations, lights, torch.ones_like(observations) > 0, batch.scene, torch.ones(40, 1))
    # Without a turn beyond multiples of 90 degrees, centres stay centres.
    cosine, sine = torch.zeros(40), torch.ones(40)
    views = network.look(observations, lights)
    dense, normals = truth_in_frame(seen, cosine, sine, views.scale, mirror)
    turned = torch.stack((-lights[:, 1], lights[:, 0], lights[:, 2]), dim=1)
    expected_normals = torch.stack(
        (-seen.scene.normals[:, 1], *seen.scene.normals[:, [0, 2]].unbind(1)), dim=1
    )
    if mirror:
        turned, expected_normals = (
            vectors * torch.tensor((1.0, -1.0, 1.0)) for vectors in (turned, expected_normals)
        )
    sparse = sparse_map(observations / views.scale, turned)
    assert sparse.holds[0].sum() == len(lights)
    torch.testing.assert_close(dense * sparse.holds, sparse.values.clamp(max=1), rtol=2e-3, atol=1e-4)
    torch.testing.assert_close(normals, expected_normals)
    assert dense.max() <= 1


def test_the_average_follows_the_weights(tiny: TrainingConfig, tmp_path: Path) -> None:
    trainer = Trainer(replace(tiny, average_decay=0.3), tmp_path, CPU)
    expected = [parameter.detach().clone() for parameter in trainer.network.parameters()]
    for step in range(4):
        trainer.step()
        decay = min(0.3, (1 + step) / (10 + step))
        expected = [
            decay * average + (1 - decay) * current.detach()
            for average, current in zip(expected, trainer.network.parameters(), strict=True)
        ]
    assert math.isclose(decay, 4 / 13) or decay == 0.3
    for average, wanted in zip(trainer.average.parameters(), expected, strict=True):
        torch.testing.assert_close(average, wanted)
