"""Training configurations and presets, and the names of them that load without PyTorch."""

import json
from typing import Any

import pytest

from splinecli.errors import ModelError
from splinecli.networks.config import NetworkConfig
from splinecli.training import defaults
from splinecli.training.config import PRESETS, TrainingConfig, preset


@pytest.mark.parametrize("name", list(PRESETS))
def test_round_trip_through_json(name: str) -> None:
    config = preset(name, seed=7, minutes=0.5)
    assert TrainingConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_settings_left_out_have_their_defaults() -> None:
    assert TrainingConfig.from_dict({}) == TrainingConfig()
    partial = TrainingConfig.from_dict({"network": {"width": 8}, "steps": 5, "learning_rate": 1})
    assert partial.network == NetworkConfig(width=8)
    assert (partial.steps, partial.learning_rate, partial.batch_size) == (5, 1, TrainingConfig().batch_size)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stepz": 5}, "unknown training setting 'stepz'; known are angle_weight, asymmetric_weight"),
        ({"network": {"lights": 5}}, "unknown network setting 'lights'"),
        ({"pixels": ["wall_share"]}, "'pixels' is .* expected a table of settings"),
        ({"steps": 0}, "training setting 'steps' is 0; expected a whole number of at least 1"),
        ({"steps": True}, "'steps' is True"),
        ({"learning_rate": "fast"}, "'learning_rate' is 'fast'; expected a number of at least 0"),
        ({"schedule": "linear"}, "'schedule' is 'linear'; expected 'cosine' or 'stepped'"),
        ({"pixels": {"wall_share": 1.5}}, "'wall_share' is 1.5; expected a number from 0 to 1"),
        ({"pixels": {"cast_shadows": 1}}, "'cast_shadows' is 1; expected true or false"),
        ({"pixels": {"min_lights": 9, "max_lights": 8}}, "max_lights are 9, 10, 8; expected them in rising order"),
        ({"ne_net_norm": ["sum"]}, "expected 'mean' or 'sum'"),
        ({"held_share": 1.1}, "'held_share' is 1.1; expected a number from 0 to 1"),
        ({"sources": {"set": True}}, "'sources' is {'set': True}; expected a table, each a number of at least 0"),
    ],
)
def test_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        TrainingConfig.from_dict(values)


def test_presets_by_name() -> None:
    # The paper's section 4; its code where that is silent (docs/train.md).
    paper = preset("paper")
    assert (paper.batch_size, paper.learning_rate, paper.steps) == (128, 1e-4, 200_000)
    assert (paper.beta1, paper.beta2, paper.weight_decay) == (0.9, 0.999, 0.0)
    assert (paper.updates, paper.ne_net_updates) == ("alternating", 5)
    assert (paper.symmetric_weight, paper.asymmetric_weight) == (2e-2, 2e-5)
    assert (paper.eta, paper.lambda_c) == (1.0, 50.0)
    assert (paper.pixels.min_lights, paper.pixels.max_lights, paper.pixels.usual_lights) == (10, 10, 10)
    assert paper.network.size == "paper"


def test_the_names_of_presets_are_those_of_the_presets() -> None:
    assert tuple(PRESETS) == defaults.PRESET_NAMES
    assert defaults.DEFAULT_PRESET in PRESETS
