"""Fixtures of a training run that takes a second."""

import pytest

from splinecli.estimate.networks.config import NetworkConfig
from splinecli.workshop.synthesis.pixels import PixelGeneratorConfig
from splinecli.workshop.training import tasks
from splinecli.workshop.training.config import TrainingConfig
from tiny_networks import TINY


@pytest.fixture(autouse=True)
def small_validation(monkeypatch):
    monkeypatch.setattr(tasks, "VALIDATION_PIXELS", 64)


@pytest.fixture
def tiny():
    return TrainingConfig(
        network=NetworkConfig(**TINY),
        pixels=PixelGeneratorConfig(max_lights=16),
        batch_size=16,
        steps=6,
        warmup_steps=0,
        precision="float32",
    )
