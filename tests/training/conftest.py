"""A training run that takes a second."""

from __future__ import annotations

import pytest

from splinecli.networks.config import NetworkConfig
from splinecli.synthesis.pixels import PixelGeneratorConfig
from splinecli.training.config import TrainingConfig


@pytest.fixture
def tiny() -> TrainingConfig:
    return TrainingConfig(
        network=NetworkConfig(width=8, li_blocks=1, ne_blocks=1, head_width=16),
        pixels=PixelGeneratorConfig(max_lights=16),
        batch_size=16,
        steps=6,
        warmup_steps=0,
        precision="float32",
    )
