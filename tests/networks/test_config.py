"""Network configurations."""

import json
from typing import Any

import pytest

from splinecli.errors import ModelError
from splinecli.networks.config import NetworkConfig


def test_round_trip() -> None:
    config = NetworkConfig(size="paper", map_size=16, width=5, grid="cnn-ps", interpolates=False)
    assert NetworkConfig.from_dict(config.to_dict()) == config
    assert NetworkConfig.from_dict({}) == NetworkConfig()
    config = NetworkConfig(fits=("ia14", "ls"))
    assert NetworkConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"grid": "odd"}, "network setting 'grid' is 'odd'; expected 'even' or 'cnn-ps'"),
        ({"grid": "cnn-ps"}, "network setting 'grid' is 'cnn-ps'; it needs the size 'paper'"),
        ({"size": "huge"}, "network setting 'size' is 'huge'; expected 'paper' or 'compact'"),
        ({"fits": ["cow"]}, r"'fits' has 'cow'; expected a list of ls, iw12, iw12-all, ia14"),
        ({"size": "paper", "fits": ["ls"]}, "'fits' needs the size 'compact'"),
        ({"interpolates": "no"}, "'interpolates' is 'no'; expected true or false"),
        ({"width": 0}, "network setting 'width' is 0; expected a whole number from 2 to 4096"),
        ({"ne_blocks": True}, "'ne_blocks' is True"),
        ({"li_blocks": 5000}, "'li_blocks' is 5000"),
        ({"set_width": 20}, "'set_width' is 20; expected a multiple of 16"),
        ({"size": "paper", "set_width": 16}, "'set_width' needs the size 'compact'"),
        ({"map_size": 30}, "'map_size' is 30; expected a whole number from 8 to 128, a multiple of 4"),
        ({"size": "paper", "error_head": True}, "'error_head' needs the size 'compact'"),
        ({"map_size": 4096}, "'map_size' is 4096"),
    ],
)
def test_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        NetworkConfig.from_dict(values)
