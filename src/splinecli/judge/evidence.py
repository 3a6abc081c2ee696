"""The evidence shared by all checks: a capture's lights, a sample of its pixels, and the quantities
that are fitted to them only once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from splinecli.capture import Capture
from splinecli.capture.light_rows import USUAL_FRAME, LightFrame
from splinecli.capture.near_lamps import NearLamps
from splinecli.capture.sample import Sample, closeup_of, sample_observations
from splinecli.capture.source import Source
from splinecli.images.registration import Shift, moved, shifts_of_detail, shifts_of_shading
from splinecli.judge.explanations import (
    TIMES,
    Doubt,
    Explanation,
    Explanations,
    Kind,
    constant_light,
)
from splinecli.judge.judge_net import CLASSES, RIGHT, TRANSLUCENT, features_of, judge_net
from splinecli.judge.light_check import LightCheck, check_lights
from splinecli.judge.tilt import Tilt, find_tilt, fitted_map
from splinecli.lights.light_fit import Factors, divide_by_fitted, find_factors
from splinecli.lights.rough_normals import median_turn_deg
from splinecli.maths import Bools, Float64Array, Floats
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import thin_out
from splinecli.maths.robust import solve_each

_COARSE_PIXELS, _COARSE_VALUES = 3000, 100_000


class ImageShift(NamedTuple):
    """An image whose detail is `right` pixels to the right of, and `down` pixels below, its place
    in the others.
    """

    place: int
    right: int
    down: int

    def __str__(self) -> str:
        """Return the shift as "2 right 1 up"."""
        directions = [(self.right, "right", "left"), (self.down, "down", "up")]
        return " ".join(
            f"{abs(by)} {more if by > 0 else less}" for by, more, less in directions if by
        )


@dataclass(frozen=True, eq=False)
class Evidence:
    """F images and their lights, the input of the checks.

    Quantities that several checks need, such as factors, the best explanation and shifts, are
    computed once, on first use.
    """

    names: Sequence[str]
    all_directions: Float64Array  # (N, 3), all lights in the order of the file
    indices: Sequence[int]  # (F,), the lights of the images
    sample: Sample  # not divided by estimated intensities
    closeup: Sample  # likewise
    intensities_measured: bool  # whether the intensities were given
    # (F,), given intensities, by which the observations were divided
    intensities: Float64Array | None = None
    # (F,), estimated intensities, by which the sample was not divided
    estimated: Float64Array | None = None
    eight_bit: bool = False  # whether the images have 8 bits
    # all near lamps, over the sample's grid; None if the lights are treated as distant
    lamps: NearLamps | None = None
    has_positions: bool = False  # whether lamp positions are known
    # whether the lights were estimated from these images, which therefore cannot contradict them
    found: bool = False
    origin: Path = Path("light_directions")
    frame: LightFrame = USUAL_FRAME
    linear: bool = True  # whether the values of the images are treated as linear
    curve: float | None = None  # exponent with which they were decoded
    truth: Floats | None = None  # (H, W, 3), the ground truth of the whole images, or None
    strict: bool = False  # also warn of properties that the images leave undetermined
    in_channels: bool = False  # whether each channel of a colour image has its own light
    copies: Sequence[tuple[int, int]] = ()  # places of images whose files are equal
    background: float = 0.0  # share of dark background that was left out of the sample
    # from earlier checks: readings that were accepted, and places of images that were moved back
    accepted: frozenset[Kind] = frozenset()
    moved: frozenset[int] = frozenset()

    @classmethod
    def of(cls, source: Source, capture: Capture, *, strict: bool = False) -> Evidence:
        """Return the evidence for a capture that was prepared from this source."""
        indices, measured = capture.light_indices, source.intensities_measured
        sample = sample_observations(capture.observations, capture.mask)
        if capture.estimated_intensities is not None:
            # They were estimated under the lights that are to be checked.
            stored = sample.observations * capture.estimated_intensities
            sample = replace(sample, observations=stored)
        closeup = closeup_of(capture.mask)
        return cls(
            source.image_names(indices),
            source.light_directions,
            indices,
            sample,
            sample_observations(capture.observations, capture.mask, closeup),
            measured,
            intensities=gray_intensities(source.light_intensities[list(indices)])
            if measured
            else None,
            estimated=capture.estimated_intensities,
            eight_bit=source.has_8_bits(indices),
            lamps=source.lamps_on_grid(sample.mask, sample.step),
            has_positions=source.has_positions,
            found=capture.light_errors_deg is not None,
            origin=source.lights_file,
            frame=source.light_frame,
            linear=source.is_linear,
            truth=capture.ground_truth,
            strict=strict,
            in_channels=source.in_channels,
            copies=source.equal_images(indices),
        )

    @cached_property
    def directions(self) -> Float64Array:
        """The directions (F, 3) of the images' lights."""
        return self.all_directions[list(self.indices)]

    @cached_property
    def observations(self) -> Floats:
        """The sample's observations (p, F) as they would be if near lamps were distant.

        The surface is assumed to be a plane. The part that a matte surface explains is replaced;
        the rest, such as the residual of lights in a wrong order, is kept.
        """
        if self.lamps is None:
            return self.sample.observations
        lamps = self.lamps.choose_lights(self.indices)
        near, attenuation = lamps.light_at(lamps.plane_points(*np.nonzero(self.sample.mask)))
        observations = self.sample.observations / attenuation
        scaled_normals = solve_each(observations, near)
        return np.asarray(
            observations + np.einsum("pfc,pc->pf", self.directions - near, scaled_normals)
        )

    @cached_property
    def factors(self) -> Factors | None:
        return find_factors(self.observations, intensities_known=self.intensities_measured)

    @cached_property
    def evened(self) -> Sample:
        """The sample, divided by the best-fitting intensities unless they were measured.

        This keeps unequal lamps from looking like a fault of the directions or the values.
        """
        values = divide_by_fitted(self.observations, self.directions, self.factors)
        return replace(self.sample, observations=values)

    @cached_property
    def explanations(self) -> Explanations:
        """The other readings of the sample, computed from its values as stored in the files."""
        observations = (
            self.observations if self.intensities is None else self.observations * self.intensities
        )
        sample = replace(self.sample, observations=observations)
        return Explanations(sample, self.directions, self.intensities)

    @cached_property
    def coarse(self) -> Evidence:
        """The evidence for fewer pixels, for quantities that are computed for each reading."""
        most = min(_COARSE_PIXELS, _COARSE_VALUES // len(self.indices))
        step = int(np.ceil(np.sqrt(len(self.sample.observations) / most)))
        if step < 2:
            return self
        sample = Sample(
            *thin_out(self.observations, self.sample.mask, step), self.sample.step * step
        )
        return replace(self, sample=sample, closeup=sample, lamps=None)

    @cached_property
    def shares(self) -> dict[str, float]:
        """The probability of each class in judge_net.py; empty if the capture cannot be judged."""
        features = features_of(self)
        if features is None:
            return {}
        return dict(zip(CLASSES, judge_net().probabilities(features).tolist(), strict=True))

    @cached_property
    def open_kinds(self) -> set[Kind]:
        """The kinds of readings that may be right instead of the given reading."""
        kinds = set(self.explanations.readings) - self.accepted
        if not self.linear:
            kinds -= {"curve"}
        if self.has_positions:  # treating them as distant explains all other findings
            kinds = kinds - {"near"} if self.lamps is not None else set()
        if self.estimated is not None:  # and divided out
            kinds -= {"intensities"}
        return kinds

    @cached_property
    def doubt(self) -> Doubt | None:
        """The most probable other reading with its probability; None if the given reading is more
        probable, or if the readings cannot be compared.
        """
        shares, kinds = self.shares, self.open_kinds
        if not kinds:
            return None
        best, *others = sorted(kinds, key=lambda kind: -shares[kind])
        if shares[best] < max(shares[RIGHT], shares[TRANSLUCENT]):
            return None
        total = float(sum(shares[kind] for kind in kinds))
        # Explanations that are at least this likely, relative to the likeliest one, are also named.
        readings = self.explanations.readings
        worse = {kind for kind in others if readings[kind].ratio > TIMES * readings[best].ratio}
        likely = tuple(k for k in others if shares[k] > 0.3 * shares[best] and k not in worse)
        return Doubt(readings[best], total, likely, worse == set(others))

    @cached_property
    def tilt(self) -> Tilt | None:
        """The common tilt of the lights, estimated from the curl of the normals."""
        return find_tilt(self.coarse.normals, self.coarse.sample.mask)

    @cached_property
    def normals(self) -> Floats:
        """The normals (h, w, 3) of a robust fit to the sample."""
        return fitted_map(self.evened.observations, self.sample.mask, self.directions)

    @cached_property
    def light_check(self) -> LightCheck:
        """The result of comparing the images with their lights."""
        return check_lights(
            self.observations,
            self.sample.mask,
            self.all_directions,
            self.indices,
            self.names,
            self.factors,
        )

    @cached_property
    def shifts(self) -> list[ImageShift]:
        """The images that are shifted relative to the others."""
        if self.factors is None:
            return []
        intensities = self.factors.intensities(self.directions[None])[0]
        lights = self.directions * intensities[:, None]
        shifts = _shifts_in(self.closeup, shifts_of_detail, lights)
        if not shifts and self.sample.step > 1:
            shifts = _shifts_in(self.sample, shifts_of_detail, lights)
        found = list(shifts.values())
        if self.found:
            return found
        distant = replace(self.sample, observations=self.observations)
        shifts = _shifts_in(distant, shifts_of_shading, lights) | shifts
        together = [shifts[place] for place in sorted(shifts)]
        # The light check of the moved images is needed anyway, the check of the given ones rarely.
        if (
            len(together) == len(found)
            or self.moved_back(together).light_check.order is None
            or self.light_check.order is None
        ):
            return self._of_one_place(together)
        return found  # the lights are in another order, so they cannot predict shading

    def _of_one_place(self, shifts: list[ImageShift]) -> list[ImageShift]:
        """Return the images that are at one place, if moving only these back explains much more.

        If the camera moved once, both parts of the images differ from their common prediction.
        """
        groups = dict[tuple[int, int], list[ImageShift]]()
        for shift in shifts:
            groups.setdefault((shift.right, shift.down), []).append(shift)
        if len(groups) != 2:
            return shifts

        def residual(moved: list[ImageShift]) -> float:
            factors = self.moved_back(moved).factors
            return np.inf if factors is None else factors.residual

        best = min(groups.values(), key=residual)
        return best if residual(best) < 0.8 * residual(shifts) else shifts

    @cached_property
    def shift_error_deg(self) -> float | None:
        """The median angle in degrees by which shifted images change the normals; None if the
        lights were estimated or no pixels are left.
        """
        if self.found:
            return None
        known, values = self._moved_values(self.evened, self.shifts)
        if not known.any():
            return None
        return median_turn_deg(
            self.evened.observations[known], self.directions, self.directions, values[known]
        )

    @staticmethod
    def _moved_values(sample: Sample, shifts: Sequence[ImageShift]) -> tuple[Bools, Float64Array]:
        """Return which pixels (p,) all images show once those with shifts are moved back, and all
        values (p, F).
        """
        images, mask = sample.images, sample.mask
        known = mask.copy()
        for shift in shifts:
            by = round(shift.right / sample.step), round(shift.down / sample.step)
            images[shift.place] = moved(images[shift.place], by)
            known &= moved(mask, by) > 0
        return known[mask], images[:, mask].T

    @cached_property
    def _moved(self) -> dict[tuple[ImageShift, ...], Evidence]:
        return {}

    def moved_back(self, shifts: Sequence[ImageShift]) -> Evidence:
        """Return the evidence with these images moved back, for the pixels that are visible in all
        of them.
        """
        key = tuple(shifts)
        if key not in self._moved:
            known, values = self._moved_values(self.sample, shifts)
            mask = np.zeros_like(self.sample.mask)
            mask[self.sample.mask] = known
            sample = replace(self.sample, observations=values[known], mask=mask)
            places = frozenset(shift.place for shift in shifts)
            self._moved[key] = replace(self, sample=sample, moved=places)
        return self._moved[key]

    def without(self, place: int) -> Evidence:
        """Return the evidence without an image."""
        kept = [each for each in range(len(self.names)) if each != place]
        sample, closeup = (
            replace(each, observations=each.observations[:, kept])
            for each in (self.sample, self.closeup)
        )
        return replace(
            self,
            names=[self.names[each] for each in kept],
            indices=[self.indices[each] for each in kept],
            sample=sample,
            closeup=closeup,
            intensities=None if self.intensities is None else self.intensities[kept],
            estimated=None if self.estimated is None else self.estimated[kept],
            moved=frozenset(each - (each > place) for each in self.moved if each != place),
            copies=(),
        )

    def under_lights(self, directions: Float64Array) -> Evidence:
        """Return the evidence with other light directions (F, 3)."""
        every = self.all_directions.copy()
        every[list(self.indices)] = directions
        return replace(self, all_directions=every)

    def scaled(self, factors: Float64Array) -> Evidence:
        """Return the evidence with the images multiplied by factors (F,)."""
        sample, closeup = (
            replace(each, observations=each.observations * factors)
            for each in (self.sample, self.closeup)
        )
        return replace(self, sample=sample, closeup=closeup)

    def read_as(self, reading: Explanation) -> Evidence:
        """Return the evidence with the images or their lights read in another way."""
        accepted = self.accepted | {reading.kind}
        if reading.kind == "elevation":
            lights = unit(self.directions * (1, 1, reading.amount))
            return replace(self.under_lights(lights), accepted=accepted)
        if reading.kind == "intensities":
            given = np.ones(len(self.indices)) if self.intensities is None else self.intensities
            return replace(
                self.scaled(1 / reading.intensities),
                accepted=accepted,
                intensities_measured=True,
                intensities=given * reading.intensities,
            )
        if reading.kind == "near":
            width = float(np.ptp(np.flatnonzero(self.sample.mask.any(axis=0))) + 1)
            positions = self.all_directions * reading.amount * width
            lamps = NearLamps.of(positions, 1.0, self.sample.mask.shape, equal=True)
            return replace(self, accepted=accepted, lamps=lamps, has_positions=True)
        stated = 1.0 if self.intensities is None else self.intensities

        def mended(sample: Sample) -> Sample:
            stored = np.maximum(sample.observations * stated, 0)
            if reading.kind == "curve":
                linear = stored**reading.amount
            else:
                lights = self.directions * np.reshape(stated, (-1, 1))
                linear = np.maximum(stored - constant_light(stored, lights, reading.amount), 0)
            return replace(sample, observations=linear / stated)

        sample = mended(self.sample)
        return replace(
            self,
            sample=sample,
            closeup=sample if self.closeup is self.sample else mended(self.closeup),
            accepted=accepted,
            linear=self.linear and reading.kind != "curve",
            curve=reading.amount if reading.kind == "curve" else self.curve,
        )


def _shifts_in(
    sample: Sample,
    find: Callable[[Float64Array, Bools, Float64Array], dict[int, Shift]],
    lights: Float64Array,
) -> dict[int, ImageShift]:
    """Return the shifts that are found in a sample, in pixels of the images."""
    return {
        place: ImageShift(place, sample.step * right, sample.step * down)
        for place, (right, down) in find(sample.images, sample.mask, lights).items()
    }


def gray_intensities(intensities: Floats) -> Float64Array:
    """Return the intensities (F,), with mean 1, of lights whose colours (F, 3) or gray values (F,)
    are divided out.
    """
    values = np.asarray(intensities, np.float64)
    if values.ndim == 2:
        values = 1 / (1 / values).mean(axis=1)
    return np.asarray(values / values.mean())
