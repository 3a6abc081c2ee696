"""An opened capture: lights and facts of images loaded, pixels still on disk and read one image at
a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from splinecli.capture import linearise
from splinecli.capture.channel_lights import ChannelLights
from splinecli.capture.files import CaptureFiles
from splinecli.capture.formats.decoders import stderr_is_apart
from splinecli.capture.formats.facts import ImageHeader, StoredSize
from splinecli.capture.formats.images import (
    ExpectedSize,
    check_memory,
    check_stored_size,
    common_size,
    decode_image,
    image_bytes,
    read_mask,
)
from splinecli.capture.formats.normal_files import read_ground_truth
from splinecli.capture.light_rows import USUAL_FRAME, LightFrame
from splinecli.capture.linearise import (
    AS_STORED,
    WHOLE,
    RadiometricCalibration,
    StoredPixels,
    Window,
)
from splinecli.capture.near_lamps import LampFiles, NearLamps, check_distances, distant_lights
from splinecli.capture.record import Capture, LightFinder, StoredCapture, check_light_indices
from splinecli.errors import InputError, UsageError
from splinecli.images.alignment import (
    LARGEST_MOTION,
    MIN_IMAGES,
    AlignedImages,
    align_images,
    common_pixels,
    place_in_whole,
    reduced,
    resample,
    stride_for,
)
from splinecli.images.lens_blur import surroundings
from splinecli.images.saturation import find_object, looks_inverted, surrounds_hole
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Integers
from splinecli.records.capture_warnings import (
    GROUND_TRUTH_UPSIDE_DOWN,
    IMAGES_ALIGNED,
    CaptureWarning,
    mask_inverted,
)
from splinecli.system.machine import in_order

Item = TypeVar("Item")
Image = TypeVar("Image")
# Bytes of each pixel of the mask: normals and errors (20), their maps (16), and arrays that are
# needed for a while.
BYTES_OF_RESULTS = 52
Progress = Callable[[], object]  # called once after each image

LEAST_COMMON = 0.25  # share of the object that all aligned images must show


@dataclass(frozen=True, eq=False)
class CaptureSource:
    """An opened capture: lights and facts of images loaded, pixels still on disk."""

    files: CaptureFiles
    facts: tuple[ImageHeader, ...]
    light_directions: Float64Array  # (F, 3), unit; x right, y up, z to the camera. See find_lights
    light_intensities: Float64Array  # (F, 3), RGB; ones if no file gives them
    warnings: tuple[CaptureWarning, ...] = ()
    radiometry: RadiometricCalibration = AS_STORED
    # stored value from which an observation is saturated; None to find it
    white_level: float | None = None
    # (H, W), made from the images instead of a file; see find_mask
    automatic_mask: Bools | None = None
    # the motion of the images, which is undone when they are read; see align
    alignment: AlignedImages | None = None
    intensities_known: bool = True  # whether a file or the user gives the intensities
    intensities_measured: bool = True  # whether a file gives the intensities
    # the frame of the light file, in which the directions are no longer
    light_frame: LightFrame = USUAL_FRAME
    lamps: LampFiles | None = None  # the near lamps of files and options, or None
    # (3, 3) in pixels of whole images. None is an orthographic camera
    camera_matrix: Float64Array | None = None
    # if each channel of a colour image is an image of its own
    channels: ChannelLights | None = None
    # the part of the images that is read. All masks but those in files have its size
    window: Window = WHOLE
    # finds the lights from the images; then the directions mean nothing
    find_lights: LightFinder | None = None
    # JSON values that change when a file that is read for the capture, or the given white level,
    # does. They are taken before reading, so a file that changed meanwhile has another stamp the
    # next time
    stamp: tuple[Any, ...] = ()

    @property
    def n_lights(self) -> int:
        return len(self.light_directions)

    def image_names(self, indices: Sequence[int]) -> list[str]:
        """Return the names of images for messages, with the channel if each channel is an image of
        its own.
        """
        names, numbers = [self.files.images[index].name for index in indices], self.files.kept
        if self.channels is None:
            return names
        channels = ["RGB"[(index if numbers is None else numbers[index]) % 3] for index in indices]
        return [f"{name} ({channel})" for name, channel in zip(names, channels, strict=True)]

    def places_of(self, light_numbers: Sequence[int] | None) -> Sequence[int] | None:
        """Return the indices of lights from their numbers in the light file. Raises UsageError."""
        if light_numbers is None or self.files.kept is None:
            return light_numbers
        for number in check_light_indices(light_numbers, self.files.kept[-1] + 1):
            if number not in self.files.kept:
                hint = "Leave it out: its direction is wrong"
                raise UsageError(f"light {number} was left out, and cannot be chosen", hint=hint)
        return [self.files.kept.index(number) for number in light_numbers]

    def read(
        self,
        light_indices: Sequence[int] | None = None,
        progress: Progress = lambda: None,
        *,
        as_stored: bool = False,
    ) -> Capture:
        """Return the capture under the chosen lights (None for all), in the order given.

        Only the images of these lights are read. At most one full image is in memory beside the
        result. Values outside the mask are ignored.

        Args:
            as_stored: use the stored values alone. By default, the blur of the lens is removed (see
                remove_blur), saturated observations are restored (see restore_saturated), and light
                intensities that no file gives are estimated (see estimate_light_intensities).

        Raises:
            UsageError: an index is out of range or repeated, or there are fewer than three.
            InputError: an image, the mask or the ground truth cannot be read or does not fit the
                others, or Capture rejects the lights.
        """
        stored = self.read_stored(light_indices, progress, as_stored=as_stored)
        return stored.capture if as_stored else stored.restore(stored.estimate_intensities())

    def read_stored(
        self,
        light_indices: Sequence[int] | None = None,
        progress: Progress = lambda: None,
        *,
        as_stored: bool = False,
    ) -> StoredCapture:
        """Return the values under the chosen lights and the data needed to restore the saturated
        ones; see read.

        Unless `as_stored` is set, the blur of the lens is removed (see remove_blur), and colours of
        lamps that differ are divided out, unless the user states that lamps are equal.
        """
        everything = tuple(range(self.n_lights))
        indices = (
            everything
            if light_indices is None
            else check_light_indices(light_indices, self.n_lights)
        )
        mask = self._read_mask_if_room(indices)
        ground_truth, upside_down = None, False
        if self.files.ground_truth is not None:
            ground_truth, upside_down = read_ground_truth(
                self.files.ground_truth, self.window.whole(mask)
            )
            ground_truth = self.window.of(ground_truth)
        around = surroundings(mask) if not as_stored and self.window.step == 1 else None

        def images(colours: Float64Array | None) -> Iterator[StoredPixels]:
            rgb = self.light_intensities.copy()
            if colours is not None:
                rgb[list(indices)] *= colours
            source = replace(self, light_intensities=rgb)
            return source.read_pixels(mask, indices, lambda pixels: pixels, progress, around=around)

        equal = self.intensities_known and not self.intensities_measured
        observed = linearise.read_observations(
            images,
            mask,
            around,
            len(indices),
            self.white_level,
            divides_colours=not (equal or as_stored),
        )
        warnings = [*self.warnings, *observed.warnings]
        if upside_down:
            text = "The rows of the ground truth are in reverse order, so the map was flipped."
            warnings.append(CaptureWarning(GROUND_TRUTH_UPSIDE_DOWN, text))
        lamps, of_lamps = self.near_lamps(mask)
        warnings += [*of_lamps, *self.mask_warnings(mask, indices)]
        camera = (
            None
            if lamps is not None or self.camera_matrix is None
            else self.window.camera(self.camera_matrix)
        )
        capture = Capture(
            self.files.name,
            observed.observations,
            self.light_directions[list(indices)],
            indices,
            mask,
            ground_truth,
            tuple(warnings),
            estimated_colours=observed.colours,
            white_level=observed.saturation.white_level,
            removed_blur=observed.blur,
            lamps=None if lamps is None else lamps.choose_lights(indices),
            camera_matrix=camera,
        )
        stored = StoredCapture(capture, observed.saturation, self.intensities_known)
        return stored if self.find_lights is None else stored.find_lights(self.find_lights)

    def find_mask(self, progress: Progress = lambda: None) -> CaptureSource:
        """Return this capture with a mask made from all its images (see find_object), unless it has
        a mask already.

        Raises InputError if no object stands out, or an image cannot be read.
        """
        if self.files.mask is not None or self.files.boundaries:
            return self
        everywhere = self.window.of(np.ones(common_size(self.facts)[0][:2], np.bool_))
        total = np.zeros(everywhere.size, np.float32)
        for colours in self.read_pixels(
            everywhere, range(self.n_lights), StoredPixels.colours, progress
        ):
            total += colours.mean(axis=1)
        try:
            mask = find_object(total.reshape(everywhere.shape))
        except InputError as error:
            raise InputError(error.problem, path=self.files.folder, hint=error.hint) from None
        return replace(
            self, automatic_mask=mask if self.alignment is None else mask & self.alignment.common
        )

    def align(
        self, light_indices: Sequence[int] | None = None, progress: Progress = lambda: None
    ) -> CaptureSource:
        """Return this capture with the chosen images (None for all) aligned to the first of them;
        see align_images.

        Raises InputError if there are too few images, one does not fit the others, or they share
        too little of the object.
        """
        indices = list(range(self.n_lights) if light_indices is None else light_indices)
        names = [self.files.images[index].name for index in indices]
        if len(indices) < MIN_IMAGES:
            problem = (
                f"--align predicts each image from the others: found {len(indices)}, expected at"
                f" least {MIN_IMAGES}"
            )
            raise InputError(
                problem, path=self.files.folder, hint="Add images, or leave --align out"
            )
        shape = common_size([self.facts[index] for index in indices])[0][:2]
        mask = self.read_mask(shape)
        stride = stride_for(len(indices) * mask.size)
        read = self.read_pixels(np.ones_like(mask), indices, StoredPixels.observe, progress)
        images = np.stack([reduced(image.reshape(mask.shape), stride) for image in read])
        lights = None if self.find_lights is not None else self.light_directions[indices]
        found = align_images(images, reduced(mask.astype(np.float32), stride) > 0.5, lights)
        if found.unexplained is not None:
            name, fit = names[found.unexplained], found.fits[found.unexplained]
            if fit < found.least_fit:
                problem = (
                    f"--align cannot match {name} to the other images: at best, its correlation"
                    " with their prediction"
                    f" is {fit:.2f}, expected at least {found.least_fit:.2f}"
                )
                hint = "Leave it out with --light-indices, mask the object, or leave --align out"
                raise InputError(problem, path=self.files.folder, hint=hint)
            pixels = stride * found.moved_pixels[found.unexplained]
            problem = (
                f"--align found that {name} moved by {pixels:.0f} pixels, at one pixel by"
                f" {100 * found.largest:.0f} %"
            )
            problem += f" of the object's size; expected at most {100 * LARGEST_MOTION:.0f} %"
            hint = (
                "Read a larger part of the images, leave the image out with --light-indices, or"
                " leave --align out"
            )
            raise InputError(problem, path=self.files.folder, hint=hint)
        left, top, *_ = self.window.box or (0, 0)
        transforms = np.repeat(np.eye(3)[None], self.n_lights, axis=0)
        transforms[indices] = place_in_whole(found.transforms, left, top, stride)
        common = self.window.of(common_pixels(transforms, shape))
        share = np.count_nonzero(mask & common) / np.count_nonzero(mask)
        if share < LEAST_COMMON:
            problem = (
                f"the aligned images share {100 * share:.0f} % of the object, expected"
                f" {100 * LEAST_COMMON:.0f} %"
            )
            raise InputError(
                problem,
                path=self.files.folder,
                hint="Leave out the images that show another part of it",
            )
        moved, warnings = found.moved_pixels * stride, self.warnings
        if (found.transforms != np.eye(3)).any():
            text = (
                f"The images were aligned to {names[0]}: they moved by up to {moved.max():.1f}"
                " pixels"
            )
            text += f" ({found.model})"
            if share < 1:
                text += (
                    f"; {100 - 100 * share:.1f} % of the object is left out, because it is not in"
                    " every image"
                )
            warnings = (*warnings, CaptureWarning(IMAGES_ALIGNED, f"{text}."))
        aligned = AlignedImages(names[0], found.model, transforms, moved, common)
        return replace(self, alignment=aligned, warnings=warnings)

    def read_mask(self, shape: tuple[int, ...]) -> Bools:
        """Return the mask (H, W) of the window on images of this shape. Raises InputError, also for
        a huge shape.
        """
        if self.automatic_mask is not None:
            return self.automatic_mask
        files = self.files
        check_stored_size(shape, 1, files.images[0])
        mask, expected = (
            np.ones(shape, np.bool_),
            ExpectedSize(shape, files.images[0].name, "a mask"),
        )
        if files.boundaries:  # of CyclesPS
            mask = np.any(
                [decode_image(path, expected).max(axis=2) > 0 for path in files.boundaries], axis=0
            )
            if not mask.any():
                names = " and ".join(path.name for path in files.boundaries)
                raise InputError(
                    f"the mask is empty: every pixel of {names} is zero",
                    path=files.boundaries[0].parent,
                )
        elif files.mask is not None:
            mask = read_mask(files.mask, expected)
        mask = self.window.of(mask)
        if self.alignment is not None:
            mask = mask & self.alignment.common
        if not mask.any():
            problem = "the mask has no pixel in the part that is read"
            hint = "Choose another --crop, or a larger --scale"
            raise InputError(problem, path=files.mask or files.folder, hint=hint)
        return mask

    def mask_warnings(self, mask: Bools, indices: Sequence[int]) -> list[CaptureWarning]:
        """Warn of a mask (H, W) from a file that is probably inverted. Raises InputError."""
        path = self.files.mask
        if path is None or self.automatic_mask is not None or not surrounds_hole(mask):
            return []
        few = [indices[place] for place in np.linspace(0, len(indices) - 1, 3).astype(int)]
        images = self.read_pixels(np.ones_like(mask), few, StoredPixels.observe)
        brightness = np.sum(list(images), axis=0).reshape(mask.shape)
        return [mask_inverted(path.name)] if looks_inverted(mask, brightness) else []

    def _read_mask_if_room(self, indices: Sequence[int]) -> Bools:
        """Return the mask (H, W). Raises InputError if the sizes of images differ or the memory is
        too small.
        """
        size = common_size([self.facts[index] for index in indices])
        shape = size[0][:2]
        if self.automatic_mask is None and self.files.mask is None and not self.files.boundaries:
            n_pixels = self.window.of(np.broadcast_to(np.True_, shape)).size
            check_capture(size, n_pixels, len(indices), self.files.folder)
        mask = self.read_mask(shape)
        check_capture(size, int(np.count_nonzero(mask)), len(indices), self.files.folder)
        return mask

    def near_lamps(self, mask: Bools) -> tuple[NearLamps | None, list[CaptureWarning]]:
        """Return all near lamps over a mask (H, W), or None for distant lights, and warnings about
        them.

        Raises InputError if a lamp would be inside the object.
        """
        if self.lamps is None:
            return None, []
        lamps = self.lamps.over(self, mask)
        if lamps is None or not self.lamps.used:
            return None, distant_lights(self.lamps.positions, lamps, mask)
        return lamps, check_distances(lamps, mask, self.lamps.positions)

    def read_pixels(
        self,
        mask: Bools,
        indices: Sequence[int],
        use: Callable[[StoredPixels], Item],
        progress: Progress = lambda: None,
        wanted: Integers | slice = linearise.EVERY_PIXEL,
        around: Bools | None = None,
    ) -> Iterator[Item]:
        """Yield use(...) of the pixels of a mask (H, W) under these lights. A second thread reads
        the next image.

        Of these pixels (P,), the stored values are complete; for the linear ones, see pixel_reader.
        Raises InputError if an image cannot be read, or does not have the size of the mask.
        """
        like = self.files.images[indices[0]].name
        pixels_of = linearise.pixel_reader(
            self.radiometry, mask, len(self.facts), like, self.window, wanted, around
        )
        if self.alignment is not None:
            pixels_of = self._aligned_reader(self.alignment.transforms, mask, like, wanted, around)

        def read(index: int) -> Item:
            facts, intensity = self.facts[index], self.light_intensities[index]
            pixels = pixels_of(facts.path, index)
            if self.channels is not None:
                number = index if self.files.kept is None else self.files.kept[index]
                pixels = self.channels.observe(facts.path, *pixels, number)
            return use(StoredPixels(facts.path, *pixels, intensity, facts.white_level))

        for item in read_ahead(read, indices):
            yield item
            del item  # before the next one is decoded
            progress()

    def _aligned_reader(
        self,
        transforms: Float64Array,
        mask: Bools,
        like: str,
        wanted: Integers | slice,
        around: Bools | None,
    ) -> Callable[[Path, int], tuple[Array, Float32Array]]:
        """Return a reader like pixel_reader's, of images that are moved back as a whole."""
        whole = np.ones(self.facts[0].size[0][:2], np.bool_)
        read = linearise.pixel_reader(
            self.radiometry, whole, len(self.facts), like, replace(self.window, box=None, step=1)
        )

        def pixels(path: Path, index: int) -> tuple[Array, Float32Array]:
            of_file, light = read(path, index)
            moved = resample(
                of_file.reshape(*whole.shape, -1),
                light.reshape(*whole.shape, -1),
                transforms[index],
            )
            stored, linear = self.window.of(moved[0]), self.window.of(moved[1])
            used = linearise.take_pixels(linear, mask)[wanted]
            if around is not None:
                used = np.concatenate((used, linearise.take_around(linear, around)))
            return linearise.take_pixels(stored, mask), used

        return pixels


def read_ahead(read: Callable[[Item], Image], items: Sequence[Item]) -> Iterator[Image]:
    """Yield read(item) of each item, in order. While one result is used, a thread reads the next.

    Decoders capture all output to file descriptor 2. If Python's stderr is the same descriptor, the
    items are read one after the other, so that no message is lost.
    """
    return map(read, items) if len(items) < 2 or not stderr_is_apart() else in_order(read, items)


def capture_bytes(largest: StoredSize, n_pixels: int, n_lights: int) -> int:
    """Return the memory in bytes that `infer` needs for a capture: float32 observations, and images
    or results.
    """
    images = min(2, n_lights) * image_bytes(*largest)  # read_ahead has two
    return n_pixels * 4 * n_lights + max(images, n_pixels * BYTES_OF_RESULTS)


def check_capture(largest: StoredSize, n_pixels: int, n_lights: int, folder: Path) -> None:
    """Raise InputError if a capture needs more memory than is available; see capture_bytes."""
    height, width = largest[0][:2]
    check_memory(
        capture_bytes(largest, n_pixels, n_lights),
        f"{n_lights} images of {width} x {height} pixels, {n_pixels} of them in the mask, take",
        folder,
        hint="Mask the object, reduce the images (infer --scale), or choose fewer lights",
    )
