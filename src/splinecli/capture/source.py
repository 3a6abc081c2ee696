"""An opened capture, whose lights and image headers are loaded but whose pixels are still on disk,
to be read one image at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from splinecli.capture import linearise
from splinecli.capture.channel_lights import ChannelLights
from splinecli.capture.files import CaptureFiles
from splinecli.capture.formats.decoders import page_of, stderr_is_apart
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
from splinecli.capture.lamp_files import LampFiles
from splinecli.capture.light_rows import USUAL_FRAME, LightFrame
from splinecli.capture.linearise import (
    AS_STORED,
    WHOLE,
    RadiometricCalibration,
    StoredPixels,
    Window,
)
from splinecli.capture.near_lamps import NearLamps, check_distances, distant_lights
from splinecli.capture.record import check_light_indices
from splinecli.errors import InputError, UsageError
from splinecli.images.alignment import AlignedImages, resample
from splinecli.images.mask import looks_inverted, surrounds_hole
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Integers
from splinecli.records.capture_warnings import (
    GROUND_TRUTH_UPSIDE_DOWN,
    CaptureWarning,
    mask_inverted,
)
from splinecli.system.files import equal_files, reading
from splinecli.system.machine import count_chosen_cores, in_order

Item = TypeVar("Item")
Image = TypeVar("Image")
# Bytes per pixel of the mask for normals and errors (20), their maps (16), and temporary arrays
BYTES_OF_RESULTS = 52
Progress = Callable[[], object]  # called once after each image


@dataclass(frozen=True, eq=False, kw_only=True)
class Source:
    """Images of one object and their lights; the pixels are read one image at a time.

    The recipe (recipe/steps.py) turns a source into a Capture. There is a subclass for files and
    one for arrays.
    """

    light_directions: Float64Array  # (F, 3), unit; x right, y up, z to the camera
    light_intensities: Float64Array  # (F, 3) RGB; ones if unknown
    warnings: tuple[CaptureWarning, ...] = ()
    # stored value from which observations are saturated; None to determine it
    white_level: float | None = None
    intensities_known: bool = True  # from a file or the user
    intensities_measured: bool = True  # from a file
    # the frame of the light file; the directions are already in the usual frame
    light_frame: LightFrame = USUAL_FRAME
    # (3, 3) in pixels of whole images. None assumes an orthographic camera
    camera_matrix: Float64Array | None = None

    @property
    def n_lights(self) -> int:
        return len(self.light_directions)

    @property
    def name(self) -> str:
        raise NotImplementedError

    @property
    def has_lights(self) -> bool:
        """Whether the light directions are given."""
        return True

    @property
    def has_mask(self) -> bool:
        """Whether a mask is given, so that none is derived from the images."""
        return True

    @property
    def has_neighbours(self) -> bool:
        """Whether neighbouring pixels of the images are read, so that lens blur can be removed."""
        return True

    @property
    def lamps_may_differ(self) -> bool:
        """Whether the lamps may have different colours, because nothing states that they are
        equal.
        """
        return self.intensities_measured or not self.intensities_known

    @property
    def has_positions(self) -> bool:
        """Whether lamp positions are known."""
        raise NotImplementedError

    @property
    def lights_file(self) -> Path:
        """The file of the lights, for messages."""
        return Path("light_directions")

    @property
    def is_linear(self) -> bool:
        """Whether the stored values are treated as linear light."""
        return True

    @property
    def in_channels(self) -> bool:
        """Whether each channel of a colour image has its own light."""
        return False

    def divided_by(self, indices: Sequence[int], colours: Float64Array | None) -> Self:
        """Return the source with the images also divided by lamp colours (F, 3)."""
        if colours is None:
            return self
        intensities = self.light_intensities.copy()
        intensities[list(indices)] *= colours
        return replace(self, light_intensities=intensities)

    def image_names(self, indices: Sequence[int]) -> list[str]:
        """Return the names of images for messages."""
        raise NotImplementedError

    def mask_for(self, indices: Sequence[int]) -> Bools:
        """Return the mask (H, W). Raises InputError if the images differ in size or memory is
        insufficient.
        """
        raise NotImplementedError

    def read_ground_truth(self, mask: Bools) -> tuple[Float32Array | None, list[CaptureWarning]]:
        """Return the true normals (H, W, 3) inside a mask, or None, and warnings."""
        return None, []

    def near_lamps(self, mask: Bools) -> tuple[NearLamps | None, list[CaptureWarning]]:
        """Return all near lamps over a mask (H, W), or None for distant lights, and warnings."""
        raise NotImplementedError

    def lamps_on_grid(self, mask: Bools, step: int) -> NearLamps | None:
        """Return the near lamps over a mask (h, w) of every step-th row and column, or None for
        distant lights.
        """
        raise NotImplementedError

    def mask_warnings(self, mask: Bools, indices: Sequence[int]) -> list[CaptureWarning]:
        """Warn about a mask (H, W) that is probably inverted."""
        return []

    def camera(self) -> Float64Array | None:
        """Return the camera matrix (3, 3) of the pixels that are read."""
        return self.camera_matrix

    def has_8_bits(self, indices: Sequence[int]) -> bool:
        """Return whether an image states that it has 8 bits."""
        return False

    def equal_images(self, indices: Sequence[int]) -> list[tuple[int, int]]:
        """Return pairs of positions of images whose files are equal."""
        return []

    def read_pixels(
        self,
        mask: Bools,
        indices: Sequence[int],
        use: Callable[[StoredPixels], Item],
        progress: Progress = lambda: None,
        wanted: Integers | slice = linearise.EVERY_PIXEL,
        around: Bools | None = None,
    ) -> Iterator[Item]:
        """Yield use(...) of the pixels of a mask (H, W) under each of these lights.

        The stored values include all pixels (P,) of the mask; for the linear values, see
        pixel_reader.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureSource(Source):
    """An opened capture on disk, whose lights and image headers are loaded."""

    files: CaptureFiles
    facts: tuple[ImageHeader, ...]
    radiometry: RadiometricCalibration = AS_STORED
    # (H, W), derived from the images, not from a file
    automatic_mask: Bools | None = None
    # the motion of the images, which is compensated when they are read
    alignment: AlignedImages | None = None
    lamps: LampFiles | None = None  # the near lamps from files and options, or None
    # if each channel of a colour image is treated as a separate image
    channels: ChannelLights | None = None
    # the part of the images that is read. All masks except those in files have its size
    window: Window = WHOLE
    # JSON values that change whenever a file of the capture or the given white level changes. They
    # are computed before reading, so a file modified meanwhile gets another stamp the next time
    stamp: tuple[Any, ...] = ()

    @property
    def name(self) -> str:
        return self.files.name

    @property
    def has_lights(self) -> bool:
        return self.files.light_directions is not None

    @property
    def has_mask(self) -> bool:
        return self.files.mask is not None or bool(self.files.boundaries)

    @property
    def has_neighbours(self) -> bool:
        return self.window.step == 1

    @property
    def has_positions(self) -> bool:
        return self.lamps is not None

    @property
    def lights_file(self) -> Path:
        return self.files.light_directions or super().lights_file

    @property
    def is_linear(self) -> bool:
        return self.radiometry.curve == 1

    @property
    def in_channels(self) -> bool:
        return self.channels is not None

    def image_names(self, indices: Sequence[int]) -> list[str]:
        """Return the names of images for messages, including the channel if channels are separate
        images.
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
                hint = "Remove it from the choice, because its direction is invalid"
                raise UsageError(
                    f"light {number} cannot be chosen, because it was left out", hint=hint
                )
        return [self.files.kept.index(number) for number in light_numbers]

    def read_ground_truth(self, mask: Bools) -> tuple[Float32Array | None, list[CaptureWarning]]:
        if self.files.ground_truth is None:
            return None, []
        truth, upside_down = read_ground_truth(self.files.ground_truth, self.window.whole(mask))
        text = (
            "The rows of the ground truth are in reverse order, so the map was flipped vertically."
        )
        warnings = [CaptureWarning(GROUND_TRUTH_UPSIDE_DOWN, text)] * upside_down
        return self.window.of(truth), warnings

    def read_mask(self, shape: tuple[int, ...]) -> Bools:
        """Return the mask (H, W) of the window on images of this shape. Raises InputError, for
        example if the shape is too large.
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
            problem = "the mask has no pixels in the part that is read"
            hint = "Choose another --crop, or a larger --scale"
            raise InputError(problem, path=files.mask or files.folder, hint=hint)
        return mask

    def mask_warnings(self, mask: Bools, indices: Sequence[int]) -> list[CaptureWarning]:
        """Warn about a mask (H, W) from a file that is probably inverted. Raises InputError."""
        path = self.files.mask
        if path is None or self.automatic_mask is not None or not surrounds_hole(mask):
            return []
        few = [indices[place] for place in np.linspace(0, len(indices) - 1, 3).astype(int)]
        images = self.read_pixels(np.ones_like(mask), few, StoredPixels.observe)
        brightness = np.sum(list(images), axis=0).reshape(mask.shape)
        return [mask_inverted(path.name)] if looks_inverted(mask, brightness) else []

    def mask_for(self, indices: Sequence[int]) -> Bools:
        size = common_size([self.facts[index] for index in indices])
        shape = size[0][:2]
        if self.automatic_mask is None and not self.has_mask:
            n_pixels = self.window.of(np.broadcast_to(np.True_, shape)).size
            check_room(size, n_pixels, len(indices), self.files.folder)
        mask = self.read_mask(shape)
        check_room(size, int(np.count_nonzero(mask)), len(indices), self.files.folder)
        return mask

    def camera(self) -> Float64Array | None:
        matrix = self.camera_matrix
        return None if matrix is None else self.window.camera(matrix)

    def has_8_bits(self, indices: Sequence[int]) -> bool:
        return any((self.facts[index].stated_size or ((), 0))[1] == 1 for index in indices)

    def equal_images(self, indices: Sequence[int]) -> list[tuple[int, int]]:
        images = [self.files.images[index] for index in indices]
        if page_of(images[0])[0] != images[0] or self.channels is not None:
            return []
        with reading(self.files.folder):
            return equal_files(images)

    def lamps_on_grid(self, mask: Bools, step: int) -> NearLamps | None:
        if self.lamps is None or not self.lamps.used:
            return None
        return self.lamps.over(self, mask, step=step)

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
        """Yield use(...) of the pixels of a mask (H, W) under each of these lights.

        Other threads read the next images, one per core. The stored values include all pixels (P,)
        of the mask; for the linear values, see pixel_reader. Raises InputError if an image cannot
        be read or does not have the size of the mask.
        """
        like = self.files.images[indices[0]].name
        pixels_of = linearise.pixel_reader(self.radiometry, mask, like, self.window, wanted, around)
        if self.alignment is not None:
            pixels_of = self._aligned_reader(self.alignment.transforms, mask, like, wanted, around)

        def read(index: int) -> Item:
            facts, intensity = self.facts[index], self.light_intensities[index]
            pixels = pixels_of(facts.path, index)
            if self.channels is not None:
                number = index if self.files.kept is None else self.files.kept[index]
                pixels = self.channels.observe(facts.path, *pixels, number)
            return use(StoredPixels(facts.path, *pixels, intensity, facts.white_level))

        threads = readers(self.facts[indices[0]].size, int(np.count_nonzero(mask)))
        for item in read_ahead(read, indices, threads):
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
    ) -> Callable[[Path, int], tuple[Array, int, linearise.LightOf]]:
        """Return a reader as pixel_reader does, but for whole images whose motion is
        compensated.
        """
        whole = np.ones(self.facts[0].size[0][:2], np.bool_)
        read = linearise.pixel_reader(
            self.radiometry, whole, like, replace(self.window, box=None, step=1)
        )

        def pixels(path: Path, index: int) -> tuple[Array, int, linearise.LightOf]:
            of_file, _, light = read(path, index)
            moved = resample(
                of_file.reshape(*whole.shape, -1),
                light(linearise.EVERY_PIXEL).reshape(*whole.shape, -1),
                transforms[index],
            )
            stored, linear = self.window.of(moved[0]), self.window.of(moved[1])
            used = linearise.take_pixels(linear, mask)[wanted]
            if around is not None:
                used = np.concatenate((used, linearise.take_around(linear, around)))
            return linearise.take_pixels(stored, mask), len(used), used.__getitem__

        return pixels


def readers(largest: StoredSize, n_pixels: int) -> int:
    """Return how many images are read at once: one per core, unless they take more memory than
    capture_bytes allows.
    """
    height, width, *channels = largest[0]
    # For the file, its pixels, and the observations
    each = height * width * (2 * math.prod(channels) * largest[1] + 4)
    room = max(n_pixels * BYTES_OF_RESULTS, 1 << 29)  # PyTorch will need as much anyway
    return max(1, min(count_chosen_cores(), room // max(each, 1)))


def read_ahead(
    read: Callable[[Item], Image], items: Sequence[Item], threads: int = 1
) -> Iterator[Image]:
    """Yield read(item) for each item, in order. While a result is used, threads read the next ones.

    Decoders capture all output to file descriptor 2. If Python's stderr is the same descriptor, the
    items are read one at a time, so that no message is lost.
    """
    return (
        map(read, items)
        if len(items) < 2 or not stderr_is_apart()
        else in_order(read, items, min(threads, len(items)))
    )


def capture_bytes(largest: StoredSize, n_pixels: int, n_lights: int) -> int:
    """Return the memory in bytes that `infer` needs for a capture: for float32 observations, and
    for images or results.
    """
    images = min(2, n_lights) * image_bytes(*largest)  # read_ahead holds two
    return n_pixels * 4 * n_lights + max(images, n_pixels * BYTES_OF_RESULTS)


def check_room(largest: StoredSize, n_pixels: int, n_lights: int, folder: Path) -> None:
    """Raise InputError if a capture needs more memory than is available; see capture_bytes."""
    height, width = largest[0][:2]
    check_memory(
        capture_bytes(largest, n_pixels, n_lights),
        f"{n_lights} images of {width} x {height} pixels, of which {n_pixels} are in the mask,"
        " take",
        folder,
        hint="Mask the object, reduce the images (infer --scale), or choose fewer lights",
    )
