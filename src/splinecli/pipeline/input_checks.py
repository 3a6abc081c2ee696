"""Checks of a capture's lights and images against each other, which `infer` and `info` make."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from splinecli.capture.capture_warnings import PROBABLY_WRONG, CaptureWarning
from splinecli.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splinecli.capture import Capture, CaptureSource
    from splinecli.capture.lights.light_check import LightCheck
    from splinecli.capture.lights.light_fit import Factors
    from splinecli.capture.lights.light_frames import LightFrame
    from splinecli.capture.lights.near_lamps import NearLamps
    from splinecli.capture.sample import Sample


SMALLEST_SPREAD = 0.1
"""Lights that determine normals worse than this carry a warning; see light_spread."""

MOST_BACKGROUND = 0.5
"""Share of near black pixels above which a capture without a mask carries a warning."""

LEAST_EXPECTED = 0.1
"""Smallest expected share of normals within 5 degrees without a warning."""


@dataclass(frozen=True, eq=False)
class StatedLights:
    """What files or arguments say about the lights of F images.

    Args:
        names: of the images.
        directions: (N, 3), all lights of the file, in its order.
        indices: (F,), those of the images.
        origin: the file.
        frame: the frame in which it was read.
        intensities_measured: whether the intensities are given.
        linear: whether the values of the images are taken as linear.
        lamps: all near lamps, over the grid of the sample that is checked; None if the lights count as distant.
        has_positions: whether positions of lamps are known.
    """

    names: Sequence[str]
    directions: NDArray[np.float64]
    indices: Sequence[int]
    origin: Path
    frame: LightFrame
    intensities_measured: bool
    linear: bool
    lamps: NearLamps | None
    has_positions: bool

    @classmethod
    def of_source(cls, source: CaptureSource, sample: Sample, indices: Sequence[int]) -> StatedLights:
        """Return what the files of a capture say about the images with these indices."""
        used = source.lamps is not None and source.lamps.used
        return cls(
            names=[source.files.images[index].name for index in indices],
            directions=source.light_directions,
            indices=indices,
            origin=source.files.light_directions,
            frame=source.light_frame,
            intensities_measured=source.intensities_measured,
            linear=source.radiometry.curve == 1,
            lamps=source.lamps_over(sample.mask, step=sample.step) if used else None,
            has_positions=source.lamps is not None,
        )

    @classmethod
    def of_arrays(cls, capture: Capture, sample: Sample, *, intensities_measured: bool) -> StatedLights:
        """Return what the arguments of splinecli.estimate_normals say."""
        from splinecli.capture.lights.light_frames import USUAL_FRAME

        lamps = capture.lamps
        if lamps is not None:
            shape = (sample.mask.shape[0], sample.mask.shape[1])
            lamps = replace(lamps, pixel_size=lamps.pixel_size * sample.step, shape=shape)
        return cls(
            names=[f"images[{index}]" for index in range(capture.n_lights)],
            directions=capture.light_directions,
            indices=range(capture.n_lights),
            origin=Path("light_directions"),
            frame=USUAL_FRAME,
            intensities_measured=intensities_measured,
            linear=True,
            lamps=lamps,
            has_positions=lamps is not None,
        )


def check_capture(source: CaptureSource, capture: Capture, *, strict: bool = False) -> list[CaptureWarning]:
    """Return warnings about a capture that was read from this source; see check_sample."""
    sample, closeup = _samples(capture)
    lights = StatedLights.of_source(source, sample, capture.light_indices)
    return check_sample(lights, sample, closeup, strict=strict)[1]


def check_arrays(capture: Capture, *, intensities_measured: bool) -> list[CaptureWarning]:
    """Return warnings about a capture that was made from arrays; see check_sample."""
    sample, closeup = _samples(capture)
    lights = StatedLights.of_arrays(capture, sample, intensities_measured=intensities_measured)
    return check_sample(lights, sample, closeup)[1]


def _samples(capture: Capture) -> tuple[Sample, Sample]:
    """Return a sample and a closeup of a capture."""
    from splinecli.capture.sample import sample_observations, take_closeup

    sample = sample_observations(capture.observations, capture.mask)
    if capture.estimated_intensities is not None:
        # They were estimated under the lights that are in question.
        sample = replace(sample, observations=sample.observations * capture.estimated_intensities)
    return sample, take_closeup(capture.observations, capture.mask)


def check_sample(
    lights: StatedLights, sample: Sample, closeup: Sample, *, strict: bool = False
) -> tuple[LightCheck, list[CaptureWarning]]:
    """Return what a sample and a closeup of some images say about their lights, and all warnings.

    Args:
        sample: its observations are not divided by estimated intensities.
        strict: also warn of what the images do not tell.
    """
    from splinecli.capture import capture_warnings, image_checks
    from splinecli.capture.explanations import explain
    from splinecli.capture.image_shifts import find_shifts, shift_warning
    from splinecli.capture.lights.light_advice import light_warnings
    from splinecli.capture.lights.light_check import check_lights, light_spread
    from splinecli.capture.lights.light_fit import find_factors
    from splinecli.capture.sample import leave_out_background

    (sample, background), (closeup, _) = leave_out_background(sample), leave_out_background(closeup)
    names, observations = lights.names, sample.observations
    chosen = lights.directions[list(lights.indices)]
    if lights.lamps is not None:
        observations = _as_distant(lights.lamps.choose_lights(lights.indices), chosen, sample)
    factors = find_factors(observations, intensities_known=lights.intensities_measured)
    check = check_lights(observations, sample.mask, lights.directions, lights.indices, names, factors)
    warnings = light_warnings(check, lights.frame, lights.origin, strict=strict)
    if background > MOST_BACKGROUND:
        warnings.append(capture_warnings.no_mask(background))
    shifts = find_shifts(closeup) or (find_shifts(sample) if sample.step > 1 else [])
    odd = check.odd_image
    if odd is not None and odd.place not in [shift.place for shift in shifts]:
        warnings.insert(0, capture_warnings.image_odd(names[odd.place], odd.left, odd.brightness))
    if shifts:
        warnings.insert(0, shift_warning(shifts, names))
    spread, in_cone = light_spread(chosen)
    if spread < SMALLEST_SPREAD:
        warnings.append(capture_warnings.lights_crowded(max(spread, 1e-3), in_cone=in_cone))
    pairs = image_checks.repeated_images(sample.observations)
    if pairs:
        first, second = (names[place] for place in pairs[0])
        warnings.append(capture_warnings.repeated_images(first, second, len(pairs)))
    doubted = check.order is not None or odd is not None or spread < SMALLEST_SPREAD or bool(shifts)
    if doubted:
        return check, warnings  # the other checks rely on the lights
    if factors is not None and not lights.intensities_measured:
        # Intensities that nobody measured are not the fault of directions and values.
        observations = observations / factors.intensities(chosen[None])[0]
    seen = replace(sample, observations=observations)
    found = explain(seen, chosen, linear=lights.linear, has_positions=lights.has_positions)
    if found:
        return check, [*warnings, *found]
    if check.best is None and not lights.has_positions:
        warnings += _rough_lights(observations, factors, chosen)
    return check, warnings


def check_confidence(expected_under_5: float | None) -> list[CaptureWarning]:
    """Warn of a capture of which the network expects hardly any normal to be right; None is a method without this."""
    from splinecli.capture.capture_warnings import low_confidence

    if expected_under_5 is None or expected_under_5 >= LEAST_EXPECTED:
        return []
    return [low_confidence(expected_under_5)]


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


def _as_distant(lamps: NearLamps, directions: NDArray[np.float64], sample: Sample) -> NDArray[np.floating]:
    """Return a sample's observations (p, F) as they would be if the near lamps were distant, in directions (F, 3).

    The surface counts as a plane. What a matte surface explains is exchanged; what it does not explain, such as the
    misfit of lights in a wrong order, stays.
    """
    import numpy as np

    from splinecli.solve_3x3 import solve_each

    near, strengths = lamps.light_at(lamps.plane_points(*np.nonzero(sample.mask)))
    observations = sample.observations / strengths
    scaled_normals = solve_each(observations, near)
    return np.asarray(observations + np.einsum("pfc,pc->pf", directions - near, scaled_normals))


def refuse_if_strict(warnings: Iterable[CaptureWarning], name: str, *, strict: bool) -> None:
    """Raise InputError for the first warning that says that an input is probably wrong, if `strict`."""
    wrong = next((warning for warning in warnings if warning.code in PROBABLY_WRONG), None)
    if strict and wrong is not None:
        raise InputError(
            f"{name}: {wrong.text.removesuffix('.')}", hint="Leave --strict out to go on nevertheless"
        )
