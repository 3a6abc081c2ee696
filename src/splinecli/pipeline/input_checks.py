"""Checks of a capture's lights and images against each other, which `infer` and `info` make."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from splinecli.capture.capture_warnings import PROBABLY_WRONG, CaptureWarning
from splinecli.errors import InputError

if TYPE_CHECKING:
    from splinecli.capture import Capture, CaptureSource
    from splinecli.capture.lights.light_check import LightCheck
    from splinecli.capture.sample import Sample


def check_capture(source: CaptureSource, capture: Capture) -> list[CaptureWarning]:
    """Return warnings about a capture that was read from this source."""
    from splinecli.capture.lights.light_advice import light_warnings
    from splinecli.capture.sample import sample_observations

    sample = sample_observations(capture.observations, capture.mask)
    check = check_source(source, sample, capture.light_indices)
    return light_warnings(check, source.light_frame, source.files.light_directions)


def check_source(source: CaptureSource, sample: Sample, indices: Sequence[int]) -> LightCheck:
    """Return what a sample of the images with these indices says about the lights."""
    from splinecli.capture.lights.light_check import check_lights

    names = [source.files.images[index].name for index in indices]
    return check_lights(sample.observations, sample.mask, source.light_directions, indices, names)


def refuse_if_strict(warnings: Iterable[CaptureWarning], name: str, *, strict: bool) -> None:
    """Raise InputError for the first warning that says that an input is probably wrong, if `strict`."""
    wrong = next((warning for warning in warnings if warning.code in PROBABLY_WRONG), None)
    if strict and wrong is not None:
        raise InputError(
            f"{name}: {wrong.text.removesuffix('.')}", hint="Leave --strict out to go on nevertheless"
        )
