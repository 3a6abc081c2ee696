"""Checks of a capture's lights and images against each other, which `infer` and `info` make."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from splinecli.capture.capture_warnings import PROBABLY_WRONG, CaptureWarning
from splinecli.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splinecli.capture import Capture, CaptureSource
    from splinecli.capture.lights.light_check import LightCheck
    from splinecli.capture.lights.light_fit import Factors
    from splinecli.capture.sample import Sample


SMALLEST_SPREAD = 0.1
"""Lights that determine normals worse than this carry a warning; see light_spread."""


def check_capture(source: CaptureSource, capture: Capture, *, strict: bool = False) -> list[CaptureWarning]:
    """Return warnings about a capture that was read from this source; see check_sample."""
    from splinecli.capture.sample import sample_observations

    sample = sample_observations(capture.observations, capture.mask)
    if capture.estimated_intensities is not None:
        # They were estimated under the lights that are in question.
        sample = replace(sample, observations=sample.observations * capture.estimated_intensities)
    return check_sample(source, sample, capture.light_indices, strict=strict)[1]


def check_sample(
    source: CaptureSource, sample: Sample, indices: Sequence[int], *, strict: bool = False
) -> tuple[LightCheck, list[CaptureWarning]]:
    """Return what a sample of the images with these indices says about the lights, and all warnings.

    Args:
        sample: its observations are not divided by estimated intensities.
        strict: also warn of what the images do not tell.
    """
    from splinecli.capture import capture_warnings, image_checks
    from splinecli.capture.lights.light_advice import light_warnings
    from splinecli.capture.lights.light_check import check_lights, light_spread
    from splinecli.capture.lights.light_fit import find_factors

    names = [source.files.images[index].name for index in indices]
    lights = source.light_directions[list(indices)]
    observations = sample.observations
    if source.lamps is not None and source.lamps.used:
        observations = _as_distant(source, sample, indices)
    factors = find_factors(observations, intensities_known=source.intensities_measured)
    check = check_lights(observations, sample.mask, source.light_directions, indices, names, factors)
    light_file = source.files.light_directions
    warnings = light_warnings(check, source.light_frame, light_file, strict=strict)
    odd = check.odd_image
    if odd is not None:
        warnings.insert(0, capture_warnings.image_odd(names[odd.place], odd.left, odd.brightness))
    spread, in_cone = light_spread(lights)
    if spread < SMALLEST_SPREAD:
        warnings.append(capture_warnings.lights_crowded(max(spread, 1e-3), in_cone=in_cone))
    pairs = image_checks.repeated_images(sample.observations)
    if pairs:
        first, second = (names[place] for place in pairs[0])
        warnings.append(capture_warnings.repeated_images(first, second, len(pairs)))
    doubted = check.order is not None or odd is not None or spread < SMALLEST_SPREAD
    if doubted:
        return check, warnings  # the other checks rely on the lights
    if source.radiometry.gamma == 1:
        ratio = image_checks.decoding_ratio(observations, factors, lights)
        if ratio is not None and ratio < image_checks.DISPLAY_RATIO:
            return check, [*warnings, capture_warnings.encoded_values(ratio)]
    if check.best is None and source.lamps is None:
        warnings += _rough_lights(observations, factors, lights)
    return check, warnings


def _rough_lights(
    observations: NDArray[np.floating], factors: Factors | None, lights: NDArray[np.float64]
) -> list[CaptureWarning]:
    """Suggest to refine the lights (F, 3) where this makes them fit observations (P, F) much better."""
    from splinecli.capture.capture_warnings import rough_lights
    from splinecli.capture.restore.light_refinement import would_refine
    from splinecli.normals import angle_between_deg

    refined = would_refine(observations, factors, lights)
    if refined is None:
        return []
    return [rough_lights(angle_between_deg(refined.directions, lights), refined.fit_ratio)]


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
