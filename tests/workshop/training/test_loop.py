"""The training loop: it learns, it can be stopped and taken up,
and it says when it cannot go on.
"""

import itertools
import math
from dataclasses import fields, replace

import pytest
import torch
from pytest import approx
from torch.testing import assert_close

from distributions import seeded
from scenes import names_in, parametrize, read_json, refuses
from splinecli.errors import ModelError
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import load_weights
from splinecli.workshop.save_weights import save_weights
from splinecli.workshop.synthesis.pixels import PixelGenerator
from splinecli.workshop.training import CHECKPOINT, METRICS, WEIGHTS, loop
from splinecli.workshop.training.config import GENERATOR, TrainingConfig, preset
from splinecli.workshop.training.loop import Trainer, learning_rate
from splinecli.workshop.training.objective import compute_losses
from splinecli.workshop.training.run_files import Metrics, read_checkpoint_config, read_metrics
from splinecli.workshop.training.tasks import PixelTask

CPU = torch.device("cpu")


pytestmark = pytest.mark.usefixtures("no_pictures")


class OneBatch(PixelGenerator):
    """Draws the same batch again and again."""

    def __init__(self, config):
        super().__init__(config.pixels, seeded(config.seed))
        self.batch = PixelGenerator.draw(self, config.batch_size)

    def draw(self, pixels):
        return self.batch


COSINE = TrainingConfig(learning_rate=1.5e-3, warmup_steps=300)


@parametrize(
    "config, step, progress, expected",
    [
        (COSINE, 0, 0.0, 1.5e-3 / 300),
        (COSINE, 149, 0.0, 1.5e-3 / 2),
        (COSINE, 10_000, 0.5, 1.5e-3 * 0.505),
        (COSINE, 40_000, 1.0, 1.5e-5),
        (preset("paper"), 0, 0.899, 1e-4),
        (preset("paper"), 0, 0.9, 1e-5),
    ],
)
def test_schedules(config, step, progress, expected):
    assert learning_rate(config, step, progress) == approx(expected)


def test_normals_of_one_batch_are_learnt_by_heart(tiny, tmp_path):
    # At 1e-2 all units of so small a network may fall silent.
    config = replace(tiny, steps=300, seed=6, learning_rate=3e-3, turn_jitter_deg=0.0, shards=1)
    trainer = Trainer(config, tmp_path, CPU)
    trainer.task.source = OneBatch(config)
    results = torch.stack([trainer.step() for _ in range(config.steps)])
    loss, angle, *_ = results[-5:].mean(dim=0) / results[:3].mean(dim=0)
    assert angle < 0.5
    # The maps of 16 pixels are more than so few channels can hold.
    assert loss < 0.7


def losses(trainer, steps):
    return [trainer.step()[0].item() for _ in range(steps)]


@parametrize(
    "updates, pixels",
    """
joint | generator
joint | set
alternating | both
""",
)
def test_a_run_taken_up_goes_on_as_if_never_stopped(tiny, tmp_path, make_set, updates, pixels):
    sources = {"generator": {GENERATOR: 1.0}, "set": {}, "both": {GENERATOR: 1.0}}[pixels]
    if pixels != "generator":
        sources[str(make_set().folder)] = 1.0
    weights = {"symmetric_weight": 0.02, "asymmetric_weight": 1e-4}
    config = replace(
        tiny, updates=updates, ne_net_updates=2, sources=sources, warmup_steps=4, **weights
    )
    whole = Trainer(config, tmp_path / "whole", CPU)
    expected = losses(whole, 6)
    first = Trainer(config, tmp_path / "halves", CPU)
    assert losses(first, 3) == expected[:3]
    first.save()
    torch.rand(100)  # what others draw in between does not matter
    second = Trainer(
        read_checkpoint_config(tmp_path / "halves" / CHECKPOINT),
        tmp_path / "halves",
        CPU,
        resume=True,
    )
    assert second.counters == first.counters
    # The same operations on the same numbers; only their places in memory differ.
    assert losses(second, 3) == approx(expected[3:], rel=1e-6)
    for network in ("network", "average"):
        for name, tensor in getattr(whole, network).state_dict().items():
            assert_close(getattr(second, network).state_dict()[name], tensor, rtol=1e-5, atol=1e-7)


def test_a_run_begins_with_the_weights_it_is_given(tiny, tmp_path):
    first = Trainer(tiny, tmp_path / "first", CPU)
    first.run()
    config = replace(tiny, start_from=str(tmp_path / "first" / WEIGHTS), seed=9)
    second = Trainer(config, tmp_path / "second", CPU)
    for name, tensor in first.average.state_dict().items():
        for network in (second.network, second.average):
            assert torch.equal(network.state_dict()[name], tensor.half().float()), name
    second.run()
    # Taken up, it is where it was, not at its start.
    trained = second.network.state_dict()
    again = Trainer(replace(config, steps=99), tmp_path / "second", CPU, resume=True)
    assert all(torch.equal(again.network.state_dict()[name], trained[name]) for name in trained)


def test_a_network_learns_to_see_the_capture_from_weights_that_do_not(tiny, tmp_path):
    alone = replace(tiny, network=replace(tiny.network, map_size=16, set_width=16, set_layers=1))
    Trainer(alone, tmp_path / "first", CPU).run()
    seeing = replace(
        alone,
        network=replace(alone.network, sees_capture=True),
        pixels=replace(alone.pixels, capture_pixels=8),
        start_from=str(tmp_path / "first" / WEIGHTS),
    )
    Trainer(seeing, tmp_path / "second", CPU).run()
    contexts = load_weights(tmp_path / "second" / WEIGHTS).network.set_branch.contexts
    assert contexts is not None and contexts[0].join[2].weight.any()  # type: ignore[index]
    with refuses("with sees_capture = True, the run's has False", ModelError):
        Trainer(
            replace(alone, start_from=str(tmp_path / "second" / WEIGHTS)), tmp_path / "third", CPU
        )


def test_only_the_error_head_learns_of_errors(tiny, tmp_path):
    Trainer(tiny, tmp_path / "first", CPU).run()
    config = replace(
        tiny,
        network=replace(tiny.network, error_head=True),
        updates="error_head",
        steps=40,
        learning_rate=0.01,
        start_from=str(tmp_path / "first" / WEIGHTS),
        average_decay=0.0,
        weight_decay=0.1,
    )
    second = Trainer(config, tmp_path / "second", CPU)
    (batch, _), *_ = second.task.draw(second.counters.step)[0]
    before = compute_losses(second.network, batch, config, part="error_head").total.item()
    second.run()
    assert (
        compute_losses(second.network, batch, config, part="error_head").total.item() < before - 0.1
    )
    # Normals are what they were, to the last bit.
    first, last = (load_weights(tmp_path / name / WEIGHTS).network for name in ("first", "second"))
    assert set(last.state_dict()) - set(first.state_dict()) == {
        f"ne_net.error_head.layers.{layer}.{kind}"
        for layer in (0, 2)
        for kind in ("weight", "bias")
    }
    assert all(
        torch.equal(last.state_dict()[name], value) for name, value in first.state_dict().items()
    )
    # Trained further, the networks lose it.
    further = replace(tiny, start_from=str(tmp_path / "second" / WEIGHTS))
    assert set(Trainer(further, tmp_path / "third", CPU).network.state_dict()) == set(
        first.state_dict()
    )
    for settings in ({"updates": "error_head"}, {"network": config.network}):
        with refuses("the updates 'error_head' and 'refine_net' need", ModelError):
            replace(tiny, **settings)


def test_a_run_writes_its_files(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "REPORT_STEPS", 4)
    seen = []
    trainer = Trainer(replace(tiny, steps=10), tmp_path, CPU)
    last = trainer.run(lambda progress, metrics: seen.append((progress, metrics)))
    # And the pictures, which are not drawn here.
    assert names_in(tmp_path) == {
        CHECKPOINT,
        "config.json",
        METRICS,
        WEIGHTS,
    }
    assert [(progress, metrics.step) for progress, metrics in seen] == [
        (0.4, 4),
        (0.8, 8),
        (1.0, 10),
    ]
    assert seen[-1][1] == last
    header = (tmp_path / METRICS).read_text().splitlines()[0]
    assert header.split(",") == [field.name for field in fields(Metrics)]
    rows = read_metrics(tmp_path / METRICS)
    assert [row.step for row in rows] == [4, 8, 10]
    assert [row.pixels for row in rows] == [64, 128, 160]
    # Validated when saved: here at the end alone, on the averaged weights in the weight file.
    assert [row.validation_deg is not None for row in rows] == [False, False, True]
    loaded = load_weights(tmp_path / WEIGHTS).network
    again = trainer.task.validation_deg(loaded, bfloat16=False)
    assert again == approx(last.validation_deg, abs=0.05)  # float16
    assert rows[-1].loss == approx(last.loss, rel=1e-5)
    assert TrainingConfig.from_dict(read_json(tmp_path / "config.json")) == trainer.config


def test_minutes_bound_a_run(tiny, tmp_path, monkeypatch):
    # A clock that moves by 0.05 s each time it is read: the machine's own speed is not what is
    # tested.
    readings = itertools.count()
    monkeypatch.setattr(
        "splinecli.workshop.training.loop.time.monotonic", lambda: next(readings) * 0.05
    )
    trainer = Trainer(replace(tiny, steps=1, minutes=0.01), tmp_path, CPU)
    trainer.counters.seconds = 0.3
    assert trainer.progress == approx(0.5)
    assert trainer.run().step > 1
    assert trainer.counters.seconds >= 0.6


def poison(trainer, what):
    """Make the next loss, or its gradient alone, other than finite."""
    parameter = next(trainer.network.ne_net.parameters())
    if what == "loss":
        original = trainer.task.source.draw

        def draw(pixels):
            batch = original(pixels)
            return replace(batch, observations=batch.observations * torch.nan)

        trainer.task.source.draw = draw
    else:
        parameter.register_hook(lambda gradient: gradient * math.inf)


@parametrize(
    "what, updates",
    """
loss | joint
gradient | alternating
""",
)
def test_what_is_not_finite_ends_the_run_before_it_does_harm(tiny, tmp_path, what, updates):
    trainer = Trainer(replace(tiny, updates=updates), tmp_path, CPU)
    losses(trainer, 2)
    trainer.save()
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    weights = [
        p.detach().clone() for p in (*trainer.network.parameters(), *trainer.average.parameters())
    ]
    poison(trainer, what)
    with refuses(rf"the {what} is (nan|inf) at step 2\. .*with a lower learning rate", ModelError):
        trainer.run()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files
    after = (*trainer.network.parameters(), *trainer.average.parameters())
    assert all(torch.equal(a, b) for a, b in zip(weights, after, strict=True))
    assert trainer.counters.step == 2
    # The kept checkpoint goes on.
    assert math.isfinite(losses(Trainer(trainer.config, tmp_path, CPU, resume=True), 1)[0])


def test_validation_never_disturbs_training(tiny, tmp_path):
    plain, checked = Trainer(tiny, tmp_path / "a", CPU), Trainer(tiny, tmp_path / "b", CPU)
    expected = losses(plain, 3)
    found = []
    for _ in range(3):
        checked.task.validation_deg(checked.average, bfloat16=False)
        found += losses(checked, 1)
    assert found == expected


def test_the_average_follows_the_weights(tiny, tmp_path):
    trainer = Trainer(replace(tiny, average_decay=0.3), tmp_path, CPU)
    expected = [parameter.detach().clone() for parameter in trainer.network.parameters()]
    for step in range(4):
        trainer.step()
        decay = min(0.3, (1 + step) / (10 + step))
        expected = [
            decay * average + (1 - decay) * current.detach()
            for average, current in zip(expected, trainer.network.parameters(), strict=True)
        ]
    for average, wanted in zip(trainer.average.parameters(), expected, strict=True):
        assert_close(average, wanted)


def test_validation_is_the_mean_angle_to_the_truth(tiny):
    network, task = SplineNet(tiny.network).train(), PixelTask(tiny, range(1), CPU)
    batch = PixelGenerator(tiny.pixels, seeded(3)).draw(40)
    task.validation = [batch]
    found = task.validation_deg(network, bfloat16=False)
    with torch.no_grad():
        normals = network(batch.observations, batch.light_directions, batch.valid).normals
    errors_deg = (normals.double() * batch.truth.normals).sum(dim=1).clamp(-1, 1).acos().rad2deg()
    assert found == approx(errors_deg.mean().item(), abs=1e-3)


@pytest.fixture
def trainer(tiny, tmp_path):
    made = Trainer(tiny, tmp_path, CPU)
    made.step()
    made.save()
    return made


def test_a_checkpoint_of_another_version_or_kind_is_refused(trainer, tmp_path):
    path = tmp_path / CHECKPOINT
    whole = path.read_bytes()
    save_weights(trainer.network, path)
    with refuses("found the format splinecli-weights-1, expected", ModelError):
        read_checkpoint_config(path)
    # The checksum does not cover the header. The new text has the same length, so that the header
    # stays valid.
    assert whole.count(b"batch_size") == 1
    path.write_bytes(whole.replace(b"batch_size", b"batch_sise"))
    with refuses("unknown training setting 'batch_sise'", ModelError):
        read_checkpoint_config(path)
    renamed = whole.replace(b'\\"pixels\\": 16', b'\\"pixelz\\": 16')
    assert renamed != whole
    path.write_bytes(renamed)
    with refuses(r"the entry 'clock' in the file .* unknown field `pixelz`", ModelError):
        Trainer(trainer.config, tmp_path, CPU, resume=True)
    path.write_bytes(
        whole.replace(b"batch_size", b"batch size").replace(b'\\"seed\\": 0', b'\\"seed\\"  0')
    )
    with refuses("the entry 'config' in the file is not valid", ModelError):
        read_checkpoint_config(path)
