"""A capture with the values that its files store, and the step that restores it under a choice of lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splinecli.capture.lights.found_lights import LightFinder
from splinecli.capture.record import Capture
from splinecli.capture.restore.light_intensities import estimate_light_intensities
from splinecli.capture.restore.saturation import restore_saturated
from splinecli.capture.restore.white_level import Saturation
from splinecli.capture_warnings import ESTIMATED_INTENSITIES, CaptureWarning, estimated_lights
from splinecli.errors import InputError
from splinecli.maths import Doubles, Integers


def name_reading(*, as_stored: bool) -> str:
    """Return how a capture was read, as reports and pixel sets name it; see CaptureSource.read."""
    return "as stored" if as_stored else "restored"


@dataclass(frozen=True, eq=False)
class StoredCapture:
    """A capture as its files store it, with what is needed to restore it.

    `infer` reads the lights it uses and restores the capture once. `evaluate` reads all lights once, chooses the
    lights of each draw, and restores each choice by itself, so that both commands see the same observations. The white
    level of a choice is decided from its images alone.
    """

    capture: Capture  # the stored observations, linear, divided by the light intensities that the files give
    saturation: Saturation
    intensities_known: bool  # whether a file, an option or the image format gives the light intensities
    found_intensities: Doubles | None = None  # (F,), those that were found together with the directions, or None

    def find_lights(self, find: LightFinder) -> StoredCapture:
        """Return the capture under lights that are found from these observations.

        Raises InputError where the images do not tell the lights, or those that are found cannot give normals.
        """
        capture = self.capture
        try:
            found = find(capture.observations, capture.mask, self.intensities_known)
        except InputError as error:
            raise InputError(f"{capture.name}: {error.problem}", hint=error.hint) from None
        warnings, directions = (*capture.warnings, estimated_lights(found.errors_deg)), found.directions
        capture = replace(capture, light_directions=directions, light_errors_deg=found.errors_deg, warnings=warnings)
        return replace(self, capture=capture, found_intensities=found.intensities)

    def choose_lights(self, positions: Sequence[int]) -> StoredCapture:
        """Return the capture under some of its lights, with arrays of its own, but the warnings of all lights."""
        capture, saturation = self.capture.choose_lights(positions), self.saturation.choose_images(positions)
        if saturation.white_level != capture.white_level:
            capture = replace(capture, white_level=saturation.white_level)
        found = None if self.found_intensities is None else self.found_intensities[list(positions)]
        return replace(self, capture=capture, saturation=saturation, found_intensities=found)

    def choose_pixels(self, rows: Integers) -> StoredCapture:
        """Return the capture with these rising rows of its observations, with arrays of its own."""
        return replace(self, capture=self.capture.choose_pixels(rows), saturation=self.saturation.choose_pixels(rows))

    def estimate_intensities(self) -> Doubles | None:
        """Return light intensities (F,) estimated from all pixels; None where they are known or count as equal."""
        if self.intensities_known or self.found_intensities is not None:
            return self.found_intensities
        return estimate_light_intensities(self.capture.observations, self.saturation.flags, self._lights_of)

    def restore(self, intensities: Doubles | None) -> Capture:
        """Return the capture with its intensities divided out and its saturated observations restored.

        The observations are changed in place: this record must not be used afterwards.
        """
        observations, warnings, restored = self.capture.observations, self.capture.warnings, None
        if intensities is not None:
            observations /= intensities.astype(np.float32)
            text = (
                "The light intensities were estimated from the images: they are unequal, from"
                f" {intensities.min():.2f} to {intensities.max():.2f} times their mean. Use --intensities FILE if you"
                " have measured them, or --intensities equal to assume equal ones."
            )
            warnings = (*warnings, CaptureWarning(ESTIMATED_INTENSITIES, text))
        saturated = self.saturation.flags
        if saturated is not None:
            restored = restore_saturated(observations, saturated, self._lights_of)
        if intensities is None and restored is None:
            return self.capture
        return replace(self.capture, warnings=warnings, estimated_intensities=intensities, restored=restored)

    def _lights_of(self, rows: Integers) -> Doubles:
        """Return the light vectors of some pixels: (F, 3), or (p, F, 3) with the falloff of near lamps on a plane."""
        lamps = self.capture.lamps
        if lamps is None:
            return self.capture.light_directions
        places = np.flatnonzero(self.capture.mask)[rows]
        directions, strengths = lamps.light_at(lamps.plane_points(*np.divmod(places, self.capture.mask.shape[1])))
        return np.asarray(directions * strengths[..., None], np.float64)
