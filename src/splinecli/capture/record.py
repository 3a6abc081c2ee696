"""The capture record that all steps after the recipe use, and lights estimated from the images."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splinecli.capture.near_lamps import NearLamps
from splinecli.errors import InputError, UsageError, did_you_mean
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Integers
from splinecli.maths.pixel_grid import ray_basis
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.records.capture_warnings import CaptureWarning
from splinecli.records.white_level import WhiteLevel

_SIDES = (
    "right",
    "upper-right",
    "above",
    "upper-left",
    "left",
    "lower-left",
    "below",
    "lower-right",
)
# azimuths, counter-clockwise from the right
SIDES_DEG = {side: 45.0 * place for place, side in enumerate(_SIDES)}
ESTIMATE = "estimate"  # passed instead of a light file to estimate the lights from the images


@dataclass(frozen=True, eq=False)
class FoundLights:
    """Estimated lights of F images."""

    directions: Float64Array  # (F, 3) float64, unit; x right, y up, z to the camera
    errors_deg: Float64Array  # (F,), the expected errors of the directions in degrees
    intensities: Float64Array | None = None  # (F,), with a mean of 1; None if they are known


def azimuth_of(first_light: str) -> float:
    """Return the azimuth in degrees from a number or a side of the image such as `upper-left`.

    Raises UsageError.
    """
    try:
        azimuth = SIDES_DEG[first_light] if first_light in SIDES_DEG else float(first_light)
    except ValueError:
        azimuth = np.nan
    if not abs(azimuth) <= 360:
        raise UsageError(
            f"found {first_light!r} as the side of the first light, expected one of"
            f" {', '.join(SIDES_DEG)}, or its azimuth in degrees, counter-clockwise from the right",
            hint=did_you_mean(first_light, SIDES_DEG),
        )
    return azimuth


def placeholders(n_lights: int) -> Float64Array:
    """Return arbitrary valid directions (F, 3), for use until the lights are estimated."""
    azimuth = 2 * np.pi * np.arange(n_lights) / max(n_lights, 1)
    return np.stack((0.6 * np.cos(azimuth), 0.6 * np.sin(azimuth), np.full(n_lights, 0.8)), axis=1)


_UNIT_TOLERANCE = 1e-3
_DTYPES: dict[type[np.generic], tuple[str, ...]] = {
    np.float32: ("observations", "ground_truth"),
    np.float64: ("light_directions", "estimated_intensities", "estimated_colours", "camera_matrix"),
    np.bool_: ("mask", "restored"),
}


@dataclass(frozen=True, eq=False)
class Capture:
    """One object under F lights, photographed by a fixed camera. The record is validated on
    construction.

    Frame: x right, y up, z to the camera; light directions are unit vectors towards the light.

    Args:
        observations: (P, F) float32, linear, of the mask's pixels in row-major order: the mean over
            the channels, each divided by its light intensity.
        light_directions: (F, 3) float64, unit, above the horizon (z > 0).
        light_indices: (F,) zero-based indices of these lights in the whole capture.
        mask: (H, W) bool with P true pixels.
        ground_truth: (H, W, 3) float32 unit normals, zero where the ground truth is unknown; or
            None.
        warnings: faults that reduce accuracy, and choices made for the user.
        estimated_intensities: (F,) float64 estimated light intensities, by which the observations
            were divided because no file contains them and they differ between images, or None.
        estimated_colours: (F, 3) float64 estimated lamp colours, by which the channels were divided
            because they differ between images, or None.
        restored: (P, F) bool, true where a saturated observation was replaced with an estimate, or
            None if no observation was restored.
        white_level: the stored value from which observations are considered saturated, or None for
            floating-point images and captures that were not read from images.
        light_errors_deg: (F,) float64, the expected errors in degrees of light_directions if they
            were estimated from the images, or None.
        removed_blur: the standard deviation in pixels of the blur that was removed from the images,
            or None if none was removed.
        lamps: the near lamps; light_directions are then valid at the origin, the centre of the
            image on the object's mean plane. None for distant lights.
        camera_matrix: (3, 3) float64, in pixels of the mask, as in OpenCV. None assumes an
            orthographic camera. Near lamps have a separate camera matrix.
        mended: the codes of unambiguous faults in the input that were corrected.

    Raises:
        InputError: the shapes do not match, a value is not finite, a light is not a unit vector
            above the horizon, there are fewer than three lights or all are coplanar, the mask is
            empty, or the camera matrix is invalid.
        UsageError: the camera matrix is not 3 x 3.
    """

    name: str
    observations: Float32Array
    light_directions: Float64Array
    light_indices: tuple[int, ...]
    mask: Bools
    ground_truth: Float32Array | None = None
    warnings: tuple[CaptureWarning, ...] = ()
    estimated_intensities: Float64Array | None = None
    estimated_colours: Float64Array | None = None
    restored: Bools | None = None
    white_level: WhiteLevel | None = None
    removed_blur: float | None = None
    lamps: NearLamps | None = None
    light_errors_deg: Float64Array | None = None
    camera_matrix: Float64Array | None = None
    mended: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # The record is frozen, so dtypes are converted here. Arrays are copied only if necessary.
        for dtype, names in _DTYPES.items():
            for name in names:
                values = getattr(self, name)
                object.__setattr__(
                    self, name, None if values is None else np.asarray(values, dtype)
                )
        object.__setattr__(
            self, "light_indices", tuple(operator.index(i) for i in self.light_indices)
        )
        object.__setattr__(self, "warnings", tuple(self.warnings))
        self._check_lights()
        self._check_pixels()
        if self.camera_matrix is not None:
            ray_basis(self.camera_matrix)

    @property
    def n_lights(self) -> int:
        return len(self.light_directions)

    @property
    def n_pixels(self) -> int:
        return len(self.observations)

    def choose_lights(self, positions: Sequence[int]) -> Capture:
        """Return the capture under a selection of its lights, in the given order.

        The positions are zero-based and refer to this record's lights. Raises the errors of
        check_light_indices, and InputError if the chosen lights are coplanar.
        """
        chosen = list(check_light_indices(positions, self.n_lights))
        return replace(
            self,
            observations=self.observations[:, chosen],
            light_directions=self.light_directions[chosen],
            light_indices=tuple(self.light_indices[i] for i in chosen),
            restored=None if self.restored is None else self.restored[:, chosen],
            lamps=None if self.lamps is None else self.lamps.choose_lights(chosen),
            **{
                name: values[chosen]
                for name in ("estimated_intensities", "estimated_colours", "light_errors_deg")
                if (values := getattr(self, name)) is not None
            },
        )

    def choose_pixels(self, positions: Integers) -> Capture:
        """Return the capture with a selection of its pixels, given ascending zero-based positions
        (p,).
        """
        mask = np.zeros_like(self.mask)
        # Rows of observations are in the mask's row-major order, as are the mask's flat indices.
        mask.flat[np.flatnonzero(self.mask)[positions]] = True
        return replace(
            self,
            observations=self.observations[positions],
            mask=mask,
            restored=None if self.restored is None else self.restored[positions],
            lamps=None if self.lamps is None else self.lamps.choose_pixels(positions),
        )

    def _check_lights(self) -> None:
        lights, count = self.light_directions, len(self.light_indices)
        self._check_shape("light directions", lights, (count, 3))
        if count < MIN_LIGHTS:
            hint = "A normal has three unknowns, so at least three different lights are needed"
            found = "1 light" if count == 1 else f"{count} lights"
            raise InputError(f"{self.name}: {found}, expected at least {MIN_LIGHTS}", hint=hint)
        self._check_shape("light intensities", self.estimated_intensities, (count,))
        self._check_shape("light colours", self.estimated_colours, (count, 3))
        # NaN fails this form of the check.
        if not (np.abs(np.linalg.norm(lights, axis=1) - 1) <= _UNIT_TOLERANCE).all():
            raise InputError(f"{self.name}: a light direction is not a unit vector")
        if (lights[:, 2] <= 0).any():
            below = self.light_indices[int(np.argmax(lights[:, 2] <= 0))]
            problem = f"{self.name}: light {below} is below the horizon (z <= 0)"
            raise InputError(problem, hint="z points to the camera")
        if in_one_plane(lights):
            problem = (
                f"{self.name}: the {count} lights are coplanar, so the normals cannot be determined"
            )
            raise InputError(problem, hint="Choose lights all around the viewing direction")

    def _check_pixels(self) -> None:
        if self.mask.ndim != 2:
            raise InputError(f"{self.name}: a mask of shape {self.mask.shape}, expected (H, W)")
        n_pixels = int(np.count_nonzero(self.mask))
        if n_pixels == 0:
            raise InputError(f"{self.name}: the mask is empty")
        self._check_shape(
            "observations", self.observations, (n_pixels, self.n_lights), "(pixels, lights) = "
        )
        self._check_shape(
            "restored flags", self.restored, (n_pixels, self.n_lights), "(pixels, lights) = "
        )
        if not all(np.isfinite(block).all() for block in _blocks(self.observations)):
            raise InputError(f"{self.name}: an observation is not finite")
        self._check_shape("ground truth", self.ground_truth, (*self.mask.shape, 3), "(H, W, 3) = ")
        for block in [] if self.ground_truth is None else _blocks(self.ground_truth.reshape(-1, 3)):
            length = np.linalg.norm(block, axis=1)
            # NaN also fails this form of the check.
            if not ((length == 0) | (np.abs(length - 1) <= _UNIT_TOLERANCE)).all():
                raise InputError(
                    f"{self.name}: a ground-truth normal is neither a unit vector nor zero"
                )

    def _check_shape(
        self, name: str, array: Array | None, shape: tuple[int, ...], meaning: str = ""
    ) -> None:
        if array is not None and array.shape != shape:
            raise InputError(
                f"{self.name}: {name} of shape {array.shape}, expected {meaning}{shape}"
            )


def in_one_plane(light_directions: Float64Array) -> bool:
    """Return whether lights (F, 3) are coplanar, which Capture rejects."""
    singular_values = np.linalg.svd(light_directions, compute_uv=False)
    return bool(singular_values[-1] < 1e-3 * singular_values[0])


def check_light_indices(indices: Sequence[int], n_lights: int) -> tuple[int, ...]:
    """Return the indices as a tuple of ints, in the same order.

    Raises UsageError if an index is repeated or out of range, or if there are fewer than three.
    """
    chosen = tuple(operator.index(index) for index in indices)
    for position, index in enumerate(chosen):
        if not 0 <= index < n_lights:
            problem = f"light index {index} is out of range: the capture has {n_lights} lights"
            raise UsageError(problem, hint=f"Use light indices from 0 to {n_lights - 1}")
        if index in chosen[:position]:
            raise UsageError(f"light index {index} is listed twice", hint="List each light once")
    if len(chosen) < MIN_LIGHTS:
        raise UsageError(f"{len(chosen)} lights chosen, expected at least {MIN_LIGHTS}")
    return chosen


def _blocks(rows: Float32Array, size: int = 1 << 20) -> Iterator[Float32Array]:
    """Yield the rows in blocks, so that a check does not need a second copy of a large capture."""
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


def name_reading(*, as_stored: bool) -> str:
    """Return the word that describes in reports and pixel sets how a capture was read."""
    return "as stored" if as_stored else "restored"
