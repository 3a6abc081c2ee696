"""Everything that decides a training run, in one frozen record, and the presets by name."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from splinecli.errors import ModelError, UsageError
from splinecli.networks.config import NetworkConfig
from splinecli.synthesis.pixels import PixelGeneratorConfig


@dataclass(frozen=True)
class TrainingConfig:
    """A training run on the online pixel generator.

    Attributes:
        batch_size: pixels a step.
        learning_rate: the schedule's top; it rises over `warmup_steps` and then falls, by a cosine to a
            hundredth, or ("stepped", the authors' way) to a tenth over the last tenth.
        steps, minutes: the run's length; minutes wins where it is above 0.
        beta1, beta2, weight_decay: of AdamW.
        gradient_limit: largest norm of the gradient.
        average_decay: decay of the running average of the weights, which is what gets saved.
        turn_jitter_deg: canonical networks see each pixel turned further by up to this, either way, and half
            of the batches mirrored, so that estimates from several views can be averaged.
        map_weight, masked_weight, angle_weight: of |D - D_gt|, |M_s o (D - D_gt)| and arccos(n . n_gt).
        precision: "bfloat16" runs the convolutions so where the device has it, "float32" never.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    pixels: PixelGeneratorConfig = field(default_factory=PixelGeneratorConfig)
    batch_size: int = 256
    learning_rate: float = 1.5e-3
    schedule: Literal["cosine", "stepped"] = "cosine"
    warmup_steps: int = 300
    steps: int = 40_000
    minutes: float = 0.0
    beta1: float = 0.9
    beta2: float = 0.99
    weight_decay: float = 1e-3
    gradient_limit: float = 1.0
    average_decay: float = 0.9995
    turn_jitter_deg: float = 15.0
    map_weight: float = 1.0
    masked_weight: float = 1.0
    angle_weight: float = 1.0
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    seed: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values, as stored in checkpoints and config.json."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainingConfig:
        """Rebuild a configuration. Raises ModelError for an unknown key or a value that cannot be."""
        values = dict(values)
        network, pixels = values.pop("network", {}), values.pop("pixels", {})
        for name, table in (("network", network), ("pixels", pixels)):
            if not isinstance(table, dict):
                raise ModelError(f"training setting {name!r} is {table!r}; expected a table of settings")
        _check_settings(values, cls())
        _check_settings(pixels, PixelGeneratorConfig())
        return cls(network=NetworkConfig.from_dict(network), pixels=PixelGeneratorConfig(**pixels), **values)


_CHOICES = {"schedule": ("cosine", "stepped"), "precision": ("bfloat16", "float32")}
_AT_LEAST_ONE = ("batch_size", "steps", "min_lights", "max_lights", "usual_lights")


def _check_settings(values: dict[str, Any], defaults: TrainingConfig | PixelGeneratorConfig) -> None:
    """Raise ModelError for a setting that `defaults` does not have, or of another kind than there."""
    known = vars(defaults)
    for name, value in values.items():
        if name not in known or name in ("network", "pixels"):
            raise ModelError(f"unknown training setting {name!r}; known are {', '.join(sorted(known))}")
        default = known[name]
        if name in _CHOICES:
            expected, fits = " or ".join(map(repr, _CHOICES[name])), value in _CHOICES[name]
        elif isinstance(default, bool):
            expected, fits = "true or false", isinstance(value, bool)
        elif isinstance(default, int):
            lowest = int(name in _AT_LEAST_ONE)
            expected = f"a whole number from {lowest}"
            fits = isinstance(value, int) and not isinstance(value, bool) and value >= lowest
        else:
            highest = 1.0 if name.endswith("_share") else math.inf
            expected = "a number from 0 to 1" if highest == 1 else "a number from 0"
            fits = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= highest
        if not fits:
            raise ModelError(f"training setting {name!r} is {value!r}; expected {expected}")


PRESETS = {
    "compact": TrainingConfig(),
    "paper": TrainingConfig(
        network=NetworkConfig(size="paper"),
        batch_size=128,
        learning_rate=1e-4,
        schedule="stepped",
        warmup_steps=0,
        steps=200_000,
        beta1=0.5,
        beta2=0.999,
        weight_decay=0.0,
        turn_jitter_deg=0.0,
    ),
}


def preset(name: str, **changes: Any) -> TrainingConfig:
    """A preset with some settings changed. Raises UsageError for an unknown name."""
    if name not in PRESETS:
        raise UsageError(f"no preset named {name!r}; expected one of {', '.join(PRESETS)}")
    return replace(PRESETS[name], **changes)
