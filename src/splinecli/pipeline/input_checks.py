"""Checks of a capture's lights and images against each other, which `infer` and `info` make."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from splinecli.capture.capture_warnings import PROBABLY_WRONG, CaptureWarning
from splinecli.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splinecli.capture import Capture, CaptureSource
    from splinecli.capture.lights.light_check import LightCheck
    from splinecli.capture.sample import Sample


SMALLEST_SPREAD = 0.1
"""Lights that determine normals worse than this carry a warning; see light_spread."""


def check_capture(source: CaptureSource, capture: Capture) -> list[CaptureWarning]:
    """Return warnings about a capture that was read from this source."""
    from splinecli.capture.sample import sample_observations

    sample = sample_observations(capture.observations, capture.mask)
    return check_sample(source, sample, capture.light_indices)[1]


def check_sample(
    source: CaptureSource, sample: Sample, indices: Sequence[int]
) -> tuple[LightCheck, list[CaptureWarning]]:
    """Return what a sample of the images with these indices says about the lights, and all warnings."""
    from splinecli.capture import capture_warnings, image_checks
    from splinecli.capture.lights.light_advice import light_warnings
    from splinecli.capture.lights.light_check import light_spread

    check = check_source(source, sample, indices)
    warnings = light_warnings(check, source.light_frame, source.files.light_directions)
    names = [source.files.images[index].name for index in indices]
    lights = source.light_directions[list(indices)]
    spread, in_cone = light_spread(lights)
    if spread < SMALLEST_SPREAD:
        warnings.append(capture_warnings.lights_crowded(max(spread, 1e-3), in_cone=in_cone))
    pairs = image_checks.repeated_images(sample.observations)
    if pairs:
        first, second = (names[place] for place in pairs[0])
        warnings.append(capture_warnings.repeated_images(first, second, len(pairs)))
    if check.order is not None or spread < SMALLEST_SPREAD:
        return check, warnings  # the other checks rely on the lights
    ratio = image_checks.decoding_ratio(sample.observations, lights) if source.radiometry.gamma == 1 else None
    if ratio is not None and ratio < image_checks.DISPLAY_RATIO:
        warnings.append(capture_warnings.encoded_values(ratio))
    return check, warnings


def check_source(source: CaptureSource, sample: Sample, indices: Sequence[int]) -> LightCheck:
    """Return what a sample of the images with these indices says about the lights."""
    from splinecli.capture.lights.light_check import check_lights

    names = [source.files.images[index].name for index in indices]
    observations = sample.observations
    if source.lamps is not None and source.lamps.used:
        observations = _as_distant(source, sample, indices)
    return check_lights(observations, sample.mask, source.light_directions, indices, names)


def _as_distant(source: CaptureSource, sample: Sample, indices: Sequence[int]) -> NDArray[np.floating]:
    """Return a sample's observations (p, F) as they would be if the near lamps were distant.

    The surface counts as a plane. What a matte surface explains is exchanged; what it does not explain, such as the
    misfit of lights in a wrong order, stays.
    """
    import numpy as np

    from splinecli.solve_3x3 import solve_each

    lamps = source.lamps_over(sample.mask, step=sample.step)
    assert lamps is not None
    lamps = lamps.choose_lights(indices)
    directions, strengths = lamps.light_at(lamps.plane_points(*np.nonzero(sample.mask)))
    observations = sample.observations / strengths
    scaled_normals = solve_each(observations, directions)
    change = source.light_directions[list(indices)] - directions
    return np.asarray(observations + np.einsum("pfc,pc->pf", change, scaled_normals))


def refuse_if_strict(warnings: Iterable[CaptureWarning], name: str, *, strict: bool) -> None:
    """Raise InputError for the first warning that says that an input is probably wrong, if `strict`."""
    wrong = next((warning for warning in warnings if warning.code in PROBABLY_WRONG), None)
    if strict and wrong is not None:
        raise InputError(
            f"{name}: {wrong.text.removesuffix('.')}", hint="Leave --strict out to go on nevertheless"
        )
