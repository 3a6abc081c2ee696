"""From files to a Capture, one photograph at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.exposure import check_exposures
from splinecli.capture.formats.images import read_boundary, read_mask
from splinecli.capture.formats.normal_files import UPSIDE_DOWN, read_ground_truth
from splinecli.capture.layouts.capture_files import AMBIENT, CaptureFiles, find_named
from splinecli.capture.layouts.registry import StrPath, find_capture_files
from splinecli.capture.lights import named_lights
from splinecli.capture.lights.light_files import read_light_directions, read_light_intensities
from splinecli.capture.linearise import AS_STORED, Lineariser, RadiometricCalibration, is_display_encoded
from splinecli.capture.record import Capture, check_light_indices
from splinecli.capture.restore.auto_mask import find_object
from splinecli.capture.restore.saturation import find_saturated
from splinecli.capture.stored import StoredCapture
from splinecli.errors import InputError

EQUAL = "equal"
"""In place of a file of intensities: all lights are equally strong."""

SATURATED_SHARE = 0.01
"""The share of saturated observations above which the capture carries a warning."""

BLACK_SHARE = 0.01
"""The share of pixels without light above which the capture carries a warning."""


@dataclass(frozen=True, eq=False)
class CaptureSource:
    """A capture whose lights are read and whose images are not.

    Args:
        files: its files.
        light_directions: (F, 3) float64, unit; x right, y up, z to the camera.
        light_intensities: (F, 3) float64, RGB; ones where nothing gives them.
        knows_intensities: whether anything does.
        warnings: sentences a user should read.
        radiometry: how the images' values become linear light.
        found_mask: (H, W) bool, instead of one among the files; see find_mask.
    """

    files: CaptureFiles
    light_directions: NDArray[np.float64]
    light_intensities: NDArray[np.float64]
    warnings: tuple[str, ...] = ()
    radiometry: RadiometricCalibration = AS_STORED
    found_mask: NDArray[np.bool_] | None = None
    knows_intensities: bool = True

    @property
    def n_lights(self) -> int:
        return len(self.light_directions)

    def read(
        self,
        light_indices: Sequence[int] | None = None,
        progress: Callable[[], object] | None = None,
        *,
        as_stored: bool = False,
    ) -> Capture:
        """The capture under the chosen lights (all of them for None), in the order given.

        Only their images are read, and at most one full image is held beside the result. Values outside the
        mask are not looked at.

        Args:
            light_indices: zero-based.
            progress: called once after each image.
            as_stored: use the stored values alone. By default, saturated observations are restored (see
                restore_saturated) and light intensities that no file gives are estimated (see
                estimate_light_intensities).

        Raises:
            UsageError: an index is out of range, comes twice, or there are fewer than three.
            InputError: an image, the mask or the ground truth cannot be read or does not fit the others, or
                the lights cannot give normals (see Capture).
        """
        stored = self.read_stored(light_indices, progress)
        return stored.capture if as_stored else stored.restore(stored.estimate_intensities())

    def read_stored(
        self, light_indices: Sequence[int] | None = None, progress: Callable[[], object] | None = None
    ) -> StoredCapture:
        """Return the stored values under the chosen lights, and what restores them; see read."""
        indices = (
            tuple(range(self.n_lights))
            if light_indices is None
            else check_light_indices(light_indices, self.n_lights)
        )
        first_path = self.files.images[indices[0]]
        first = decode_image(first_path)
        mask = self.read_mask(first.shape[:2])
        ground_truth, upside_down = None, False
        if self.files.ground_truth is not None:
            ground_truth, upside_down = read_ground_truth(
                self.files.ground_truth, (mask.shape[0], mask.shape[1]), mask
            )
        linearise = Lineariser(self.radiometry, mask, len(self.files.images))
        observations = np.empty((np.count_nonzero(mask), len(indices)), np.float32)
        saturated = np.zeros((0, len(indices)), np.bool_)  # grows when there is something to say
        n_8_bit = 0
        stored: NDArray[Any] | None = first
        del first
        for position, index in enumerate(indices):
            path = self.files.images[index]
            if stored is None:
                stored = decode_image(path)
            _check_image_size(stored, mask, path, first_path)
            pixels = stored[mask]
            here = find_saturated(pixels)
            if here.any():
                if not len(saturated):
                    saturated = np.zeros(observations.shape, np.bool_)
                saturated[:, position] = here
            observations[:, position] = _observe(
                linearise(pixels, path, index), self.light_intensities[index]
            )
            n_8_bit += stored.dtype == np.uint8
            stored = None  # let go before the next is decoded: one full image at a time
            if progress is not None:
                progress()
        n_saturated = np.count_nonzero(saturated)
        n_black = len(observations) - np.count_nonzero(observations.any(axis=1))
        capture = Capture(
            name=self.files.name,
            observations=observations,
            light_directions=self.light_directions[list(indices)],
            light_indices=indices,
            mask=mask,
            ground_truth=ground_truth,
            warnings=(
                *self.warnings,
                *_warnings(n_saturated / observations.size, n_black / len(observations), n_8_bit),
                *((UPSIDE_DOWN,) if upside_down else ()),
            ),
        )
        return StoredCapture(capture, saturated if len(saturated) else None, self.knows_intensities)

    def colours(self, mask: NDArray[np.bool_]) -> Callable[[int], NDArray[np.float32]]:
        """A function that reads the mask's (H, W) pixels (P, 3) RGB of an image by its index.

        Linear, each channel divided by its light's intensity. It raises InputError where the image cannot be read, or
        does not have the size of the mask.
        """
        linearise = Lineariser(self.radiometry, mask, len(self.files.images))

        def read(index: int) -> NDArray[np.float32]:
            path = self.files.images[index]
            stored = decode_image(path)
            _check_image_size(stored, mask, path, self.files.images[0])
            return self._colours(linearise, stored[mask], index)

        return read

    def _colours(self, linearise: Lineariser, pixels: NDArray[Any], index: int) -> NDArray[np.float32]:
        linear = linearise(pixels, self.files.images[index], index)
        # In float32 and in place: of 24 megapixels, anything else is felt.
        colours = np.array(np.broadcast_to(linear, (len(linear), 3)), np.float32)
        colours /= self.light_intensities[index].astype(np.float32)
        return colours

    def find_mask(self, progress: Callable[[], object] | None = None) -> CaptureSource:
        """The same capture with a mask made from all its images (see find_object); the same where it has one.

        Raises InputError: no object stands out, or an image cannot be read.
        """
        if self.files.mask is not None or self.files.boundaries:
            return self
        linearise = None
        for index, path in enumerate(self.files.images):
            stored = decode_image(path)
            if linearise is None:
                shape = stored.shape[:2]
                linearise = Lineariser(self.radiometry, np.ones(shape, np.bool_), self.n_lights)
                total = np.zeros(shape[0] * shape[1], np.float32)
            _check_image_size(stored, linearise.mask, path, self.files.images[0])
            total += self._colours(linearise, stored.reshape(-1, stored.shape[2]), index).mean(axis=1)
            if progress is not None:
                progress()
        try:
            return replace(self, found_mask=find_object(total.reshape(shape)))
        except InputError as error:
            raise InputError(error.problem, path=self.files.folder, hint=error.hint) from None

    def read_mask(self, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """The mask of images of this shape, (H, W); all of it where the capture has none. Raises InputError."""
        image = self.files.images[0]
        if self.found_mask is not None:
            return self.found_mask
        if self.files.boundaries:
            return self._read_boundaries(shape, image)
        if self.files.mask is None:
            return np.ones(shape, np.bool_)
        mask = read_mask(self.files.mask)
        _check_mask_size(mask, shape, self.files.mask, image)
        return mask

    def _read_boundaries(self, shape: tuple[int, ...], image: Path) -> NDArray[np.bool_]:
        union = np.zeros(shape, np.bool_)
        for path in self.files.boundaries:
            boundary = read_boundary(path)
            _check_mask_size(boundary, shape, path, image)
            union |= boundary
        if not union.any():
            names = " and ".join(path.name for path in self.files.boundaries)
            raise InputError(
                f"the mask is empty: every pixel of {names} is zero", path=self.files.boundaries[0].parent
            )
        return union


def open_capture(
    folder: StrPath,
    *,
    lights: StrPath | None = None,
    intensities: StrPath | None = None,
    mask: StrPath | None = None,
    ground_truth: StrPath | None = None,
    radiometry: RadiometricCalibration = AS_STORED,
) -> CaptureSource:
    """Find a capture's files and read its lights; files named here go before those that the folder holds.

    Args:
        intensities: a file, or EQUAL.
        radiometry: how the images' values become linear light; where it names no ambient image, one called `ambient`
            in the folder is taken off.

    Raises:
        InputError: the folder holds no capture (see find_capture_files) or a light file is wrong.
    """
    equal = intensities is not None and str(intensities) == EQUAL
    files = find_capture_files(
        folder,
        lights=lights,
        intensities=None if equal else intensities,
        mask=mask,
        ground_truth=ground_truth,
    )
    path = files.light_directions
    strengths: NDArray[np.float64] | None = None
    warnings: tuple[str, ...] = ()
    if path.suffix.lower() in named_lights.SUFFIXES:
        named = named_lights.read_named_lights(path)
        images, how = named.match(files.images)
        flats = radiometry.flat_field
        if len(flats) == len(files.images) > 1:  # they lie in the order of the folder's images
            flat_of = dict(zip(files.images, flats, strict=True))
            radiometry = replace(radiometry, flat_field=tuple(flat_of[image] for image in images))
        if len(images) < len(files.images):
            warnings += (
                f"{path.name} names {len(images)} of the {len(files.images)} images; the others are left out.",
            )
        files, directions, strengths = replace(files, images=images), named.directions, named.intensities
        if how != "name":
            warnings += (f"The lights of {path.name} were matched to the images by {how}.",)
    else:
        directions = read_light_directions(path, len(files.images))
    if equal:
        strengths = None
    elif files.light_intensities is not None:
        strengths = read_light_intensities(files.light_intensities, len(files.images))
    known = equal or strengths is not None
    if strengths is None:
        check_exposures(files.images)
        strengths = np.ones((len(files.images), 3))
    found = find_named(files.folder, AMBIENT) or find_named(files.images[0].parent, AMBIENT)
    if radiometry.ambient is None and found is not None:
        radiometry = replace(radiometry, ambient=found)
        warnings += (f"The light of {found.name} was taken off all images.",)
    files = replace(files, ambient=radiometry.ambient)
    if radiometry.gamma == 1 and any(is_display_encoded(image) for image in files.images):
        warnings += (
            "The images look display-encoded (JPEG, or PNG that says so) but are taken to be linear;"
            " --transfer srgb undoes sRGB's curve.",
        )
    return CaptureSource(files, directions, strengths, warnings, radiometry, knows_intensities=known)


def read_capture(
    folder: StrPath,
    *,
    lights: StrPath | None = None,
    intensities: StrPath | None = None,
    mask: StrPath | None = None,
    ground_truth: StrPath | None = None,
    light_indices: Sequence[int] | None = None,
    progress: Callable[[], object] | None = None,
    as_stored: bool = False,
) -> Capture:
    """Open a capture and read it: see open_capture and CaptureSource.read."""
    source = open_capture(
        folder, lights=lights, intensities=intensities, mask=mask, ground_truth=ground_truth
    )
    return source.read(light_indices, progress, as_stored=as_stored)


def _observe(linear: NDArray[np.float32], intensity: NDArray[np.float64]) -> NDArray[np.float32]:
    """Linear pixels (P, C) under a light of RGB intensity (3,) -> observations (P,).

    Each channel is divided by its intensity, then the mean is taken; a gray image is equal in all channels.
    """
    weights = 1 / (3 * intensity)
    if linear.shape[1] == 1:
        weights = weights.sum(keepdims=True)
    return linear @ weights.astype(np.float32)


def _warnings(saturated_share: float, black_share: float, n_8_bit: int) -> tuple[str, ...]:
    warnings = []
    if saturated_share > SATURATED_SHARE:
        warnings.append(
            f"{100 * saturated_share:.1f} % of the observations are saturated;"
            " a shorter exposure gives better normals."
        )
    if black_share > BLACK_SHARE:
        warnings.append(
            f"{100 * black_share:.1f} % of the pixels are black under every light;"
            " they get the normal (0, 0, 1)."
        )
    if n_8_bit:
        warnings.append("The images have 8 bits; 16-bit linear images give better normals.")
    return tuple(warnings)


def _check_image_size(stored: NDArray[Any], mask: NDArray[np.bool_], path: Path, first: Path) -> None:
    if stored.shape[:2] != mask.shape:
        raise InputError(
            f"found an image of {_size(stored.shape)} pixels, expected {_size(mask.shape)} as in {first.name}",
            path=path,
        )


def _check_mask_size(mask: NDArray[np.bool_], shape: tuple[int, ...], path: Path, image: Path) -> None:
    if mask.shape != shape:
        raise InputError(
            f"found a mask of {_size(mask.shape)} pixels, expected {_size(shape)} as in {image.name}",
            path=path,
        )


def _size(shape: tuple[int, ...]) -> str:
    """Height and width as people say them: width x height."""
    return f"{shape[1]} x {shape[0]}"
