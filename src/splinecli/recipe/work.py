"""The state of a capture while the recipe prepares it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splinecli.capture.formats.images import common_size
from splinecli.capture.record import Capture
from splinecli.capture.source import CaptureSource, Source
from splinecli.errors import UsageError
from splinecli.images.saturation import Saturation
from splinecli.judge.checks import Judgement
from splinecli.maths import Float64Array, Integers
from splinecli.recipe.reading import ImageSummary
from splinecli.records.capture_warnings import CaptureWarning


@dataclass(frozen=True)
class RecipeOptions:
    """The options of the recipe."""

    # use the stored values: keep lens blur, lamp colours and saturated pixels, and do not estimate
    # intensities
    as_stored: bool = False
    auto_mask: bool = False  # if there is no mask, find the object in the images
    align: bool = False  # align images that moved between exposures
    finds_lights: bool = False  # estimate the light directions from the images
    first_light: str | None = None  # side that the first of these lights comes from
    refuses_lights: bool = True  # raise InputError for lights that the images do not determine
    judges: bool = True  # check lights and images against each other
    asks_network: bool = False  # compare given lights with others; see contradiction.py
    mends: bool = False  # correct clear faults
    keeps_lights: bool = False  # except those of the lights, because the user gave their frame
    strict: bool = False  # also warn of properties that the images leave undetermined
    refine_lights: bool = False  # refine rough light directions
    light_error_deg: float | None = None  # their typical error; None for the default

    @property
    def mends_lights(self) -> bool:
        """Whether clear faults of the lights are corrected."""
        return self.mends and not self.keeps_lights


USUAL = RecipeOptions()


@dataclass(frozen=True, eq=False)
class Work:
    """A source on its way to a capture. Each step of the recipe returns a new one.

    source: includes the mask, the motion and the lamp colours once they are found. indices: the
    images that are used, in order. colours: (F, 3), estimated lamp colours included in the source's
    intensities, or None. colours_known: whether the images have already been compared to find them.
    warnings: from the steps before the capture exists. capture, saturation, images: set by the step
    `observations`. found_intensities: (F,), estimated together with the lights, or None. judgement:
    set by the step of this name.
    """

    source: Source
    indices: tuple[int, ...]
    options: RecipeOptions = USUAL
    colours: Float64Array | None = None
    colours_known: bool = False
    warnings: tuple[CaptureWarning, ...] = ()
    capture: Capture | None = None
    saturation: Saturation | None = None
    images: tuple[ImageSummary, ...] = ()
    found_intensities: Float64Array | None = None
    judgement: Judgement | None = None

    @property
    def finds_lights(self) -> bool:
        """Whether the lights are estimated from the images, because this was requested or the
        capture has no light file.
        """
        return self.options.finds_lights or not self.source.has_lights

    @property
    def made(self) -> Capture:
        """The capture, which exists after the step `observations`."""
        assert self.capture is not None
        return self.capture

    @property
    def saturated(self) -> Saturation:
        """The saturated observations, which are known after the step `observations`."""
        assert self.saturation is not None
        return self.saturation

    @property
    def files(self) -> CaptureSource:
        """The source, for steps that need files."""
        if not isinstance(self.source, CaptureSource):
            raise UsageError("this step needs a capture in files")
        return self.source

    @property
    def shape(self) -> tuple[int, ...]:
        """The height and width of the images that are used. Raises InputError if their sizes
        differ.
        """
        return common_size([self.files.facts[index] for index in self.indices])[0][:2]

    def choose_images(self, positions: Sequence[int]) -> Work:
        """Return the work on the images at some positions, with its own capture.

        The white level is decided from these images alone, as if only they had been read.
        """
        capture, saturation = (
            self.made.choose_lights(positions),
            self.saturated.choose_images(positions),
        )
        if saturation.white_level != capture.white_level:
            capture = replace(capture, white_level=saturation.white_level)
        return replace(
            self,
            indices=tuple(self.indices[position] for position in positions),
            capture=capture,
            saturation=saturation,
            images=tuple(self.images[position] for position in positions),
        )

    def choose_pixels(self, rows: Integers) -> Work:
        """Return the work on the pixels in these rows of the observations, in ascending order."""
        capture = self.made.choose_pixels(rows)
        return replace(self, capture=capture, saturation=self.saturated.choose_pixels(rows))

    def lights_of(self, rows: Integers) -> Float64Array:
        """Return the light vectors (F, 3) of some pixels, or (p, F, 3) with the attenuation of near
        lamps for points on a plane.
        """
        capture = self.made
        if capture.lamps is None:
            return capture.light_directions
        places = np.divmod(np.flatnonzero(capture.mask)[rows], capture.mask.shape[1])
        directions, attenuation = capture.lamps.light_at(capture.lamps.plane_points(*places))
        return np.asarray(directions * attenuation[..., None], np.float64)
