"""The options of `infer`, a frozen record that can be written as JSON and pickled, and the memory that they need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import Any, get_args

import numpy as np

from splinecli.capture import CaptureSource, RadiometricCalibration, open_capture
from splinecli.capture.files import MAPS, NORMALS, SCALED_MAPS, check_not_empty, list_images
from splinecli.capture.formats.facts import StoredSize
from splinecli.capture.light_rows import LightForm, parse_light_frame
from splinecli.capture.linearise import parse_window
from splinecli.capture.near_lamps import LampOptions
from splinecli.capture.reader import EQUAL
from splinecli.capture.record import ESTIMATE, LightFinder, azimuth_of, check_light_indices
from splinecli.capture.source import capture_bytes
from splinecli.errors import SplinecliError, UsageError, check_one_of
from splinecli.evaluation.protocol import check_draw_settings
from splinecli.maths.normals import Convention
from splinecli.maths.transfer import AUTOMATIC, parse_transfer
from splinecli.methods import DEFAULT_METHOD, MethodOptions, check_method
from splinecli.pictures.maps import CURVATURE_SCALE, RELIEF_SCALE
from splinecli.pipeline.integrate import check_pixel_size
from splinecli.restoration.images import check_white_level
from splinecli.surface.bilateral_equations import STIFFNESS
from splinecli.surface.surface_files import check_exr
from splinecli.system.files import check_file
from splinecli.system.machine import Device, Precision

BASE_BYTES = 500 * 2**20  # of Python, PyTorch and a batch of pixels; captures and their refinement take more
REFINED_PIXELS, REFINED_BYTES = 736**2, 1100  # at most refined at once, a tile with its margin; of each

INDIRECT_BYTES = 4  # of each pixel of the capture, for its indirect light
_WORTH_A_MASK = 10**9  # bytes from which the mask is read to find out how much of them is needed


def infer_bytes(largest: StoredSize, n_pixels: int, n_lights: int) -> int:
    """Return the bytes of memory that spline-net takes for a capture, beside BASE_BYTES.

    They follow from the size of the largest image, and the numbers of pixels in the mask and of images that are read.
    """
    of_pixels = INDIRECT_BYTES * n_pixels + REFINED_BYTES * min(n_pixels, REFINED_PIXELS)
    return capture_bytes(largest, n_pixels, n_lights) + of_pixels


def source_bytes(open_source: Callable[[], CaptureSource], n_lights: int = 0) -> float:
    """Return about how many bytes a capture takes, from the header of its first image, and its mask if it is large.

    A capture that cannot be read takes none: it will fail soon. `n_lights` images are read, or all for 0.
    """
    try:
        source = open_source()
        size = source.facts[0].size
        n_lights = n_lights or source.n_lights
        n_pixels = source.window.of(np.broadcast_to(np.True_, size[0][:2])).size
        n_bytes = infer_bytes(size, n_pixels, n_lights)
        if n_bytes > _WORTH_A_MASK and (source.files.mask is not None or source.files.boundaries):
            n_bytes = infer_bytes(size, int(np.count_nonzero(source.read_mask(size[0][:2]))), n_lights)
    except (SplinecliError, OSError, MemoryError):
        return 0.0
    return float(n_bytes)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Which files make a capture, and how they are read: options of `infer` and `info`, as their help describes them.

    None is the default in the help. Raises UsageError.
    """

    lights: str | None = None
    first_light: str | None = None
    intensities: str | None = None
    light_positions: str | None = None
    light_distance: float | None = None
    pixel_size: float | None = None
    object_width: float | None = None
    camera_matrix: str | None = None
    mask: str | None = None
    crop: str | None = None
    scale: str | None = None
    ground_truth: str | None = None
    light_frame: str | None = None
    lights_format: LightForm = "xyz"
    transfer: str = AUTOMATIC
    ambient: str | None = None
    flat_field: str | None = None
    white_level: float | None = None
    strict: bool = False
    surface = False  # is made of the capture, too, in the unit of pixel_size; a field of InferOptions

    def __post_init__(self) -> None:
        # These concern a light file or near lamps.
        reasons = {
            "--light-positions": self.light_positions is not None and "finds distant lights",
            "--light-distance": self.light_distance is not None and "finds distant lights",
            "--light-frame": self.light_frame is not None and "needs no light file",
            "--lights-format": self.lights_format != "xyz" and "needs no light file",
        }
        for option, reason in reasons.items():
            if self.finds_lights and reason:
                raise UsageError(
                    f"--lights estimate {reason}, so it contradicts {option}",
                    hint=f"Leave {option} out, or give a light file",
                )
        if self.first_light is not None and not self.finds_lights:
            raise UsageError("--first-light needs --lights estimate", hint="Add it, or leave both out")
        if self.first_light is not None:
            azimuth_of(self.first_light)
        _ = self.lamps, parse_window(self.crop, self.scale)
        parse_transfer(self.transfer)
        parse_light_frame(self.light_frame)
        check_white_level(self.white_level)
        check_one_of("light format", self.lights_format, get_args(LightForm))

    @property
    def finds_lights(self) -> bool:
        """Whether the lights are found from the images."""
        return self.lights == ESTIMATE

    @property
    def light_file(self) -> str | None:
        """The light file that replaces that of the capture."""
        return None if self.finds_lights else self.lights

    @property
    def lamps(self) -> LampOptions:
        """The part of the options that concerns near lamps. Raises UsageError."""
        return LampOptions(
            positions=self.light_positions,
            distance=self.light_distance,
            pixel_size=self.pixel_size,
            scales_surface=self.surface,
            object_width=self.object_width,
            camera_matrix=self.camera_matrix,
        )

    def check_files(self) -> None:
        """Raise InputError if a file that the options name does not exist, or --flat-field contains no images."""
        intensities = None if self.intensities == EQUAL else self.intensities
        named = (self.light_file, self.light_positions, intensities, self.camera_matrix, self.mask)
        for name in (*named, self.ground_truth, self.ambient):
            if name is not None:
                check_file(Path(name), "a file", pipe=name == self.light_file)
        self.radiometric_calibration()

    def radiometric_calibration(self) -> RadiometricCalibration:
        """Return how the images' values become linear light. Raises InputError."""
        flats: tuple[Path, ...] = ()
        if self.flat_field is not None:
            folder = Path(self.flat_field)
            flats = tuple(list_images(folder, leave_out_stems=("ambient", "mask"), leave_out=()))
            check_not_empty(flats, folder)
        dark = None if self.ambient is None else Path(self.ambient)
        return RadiometricCalibration(parse_transfer(self.transfer), dark, flats, self.transfer == AUTOMATIC)

    def open(self, folder: Path) -> CaptureSource:
        """Open the capture in the folder under these options. Raises InputError."""
        find: LightFinder | None = None
        if self.finds_lights:
            from splinecli.lights.unknown_lights import find_lights

            find = partial(find_lights, first_light=self.first_light)

        return open_capture(
            folder,
            lights=self.light_file,
            intensities=self.intensities,
            mask=self.mask,
            ground_truth=self.ground_truth,
            radiometry=self.radiometric_calibration(),
            white_level=self.white_level,
            light_frame=parse_light_frame(self.light_frame),
            lights_format=self.lights_format,
            lamps=self.lamps,
            window=parse_window(self.crop, self.scale),
            find_lights=find,
        )


@dataclass(frozen=True, kw_only=True)
class InferOptions(Reading):
    """The options of `infer`, as its help describes them.

    Two records are equal if they give the same results. `output` and `device` do not count. Raises UsageError if a
    value is unknown, or two options contradict each other.

    Args:
        n_lights: None for all. light_indices: counted from 0.
        distil: False for the method on every pixel, None for distillation of large captures only.
        formats, maps: names of `splinecli.capture.files.NORMALS` and MAPS.
        curvature_scale, relief_scale: the value that is white in the picture; see `splinecli.pictures.maps`.
    """

    refine_lights: bool = False
    auto_mask: bool = False
    as_stored: bool = False
    n_lights: int | None = None
    seed: int = 0
    light_indices: tuple[int, ...] | None = None
    method: str = DEFAULT_METHOD
    weights: str | None = None
    distil: bool | None = None
    device: Device = field(default="auto", compare=False)
    precision: Precision = "auto"
    output: str = field(default="out", compare=False)
    formats: tuple[str, ...] = ("png", "npy")
    maps: tuple[str, ...] = ()
    curvature_scale: float = CURVATURE_SCALE
    relief_scale: float = RELIEF_SCALE
    html: bool = False
    surface: bool = False
    stiffness: float = STIFFNESS
    convention: Convention = "opengl"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_lights is not None and self.light_indices is not None:
            raise UsageError("--n-lights and --light-indices contradict each other", hint="Leave one out")
        if self.mask is not None and self.auto_mask:
            raise UsageError("--mask and --auto-mask contradict each other", hint="Leave one out")
        if self.finds_lights and self.refine_lights:
            raise UsageError("--lights estimate refines the lights that it finds", hint="Leave --refine-lights out")
        check_method(self.method)
        check_pixel_size(self.pixel_size if self.surface else None)
        if not (isfinite(self.stiffness) and self.stiffness >= 0):
            raise UsageError(f"the stiffness is {self.stiffness:g}, expected a number of at least 0")
        if self.n_lights is not None:
            check_draw_settings(self.n_lights, 1, self.seed)
        if self.light_indices is not None:
            check_light_indices(self.light_indices, max(self.light_indices, default=0) + 1)
        check_one_of("precision", self.precision, get_args(Precision))
        check_one_of("device", self.device, get_args(Device))
        check_one_of("convention", self.convention, get_args(Convention))
        for name in self.formats:
            check_one_of("format", name, NORMALS)
        for name in self.maps:
            check_one_of("map", name, MAPS)
        for name in SCALED_MAPS:
            scale = getattr(self, f"{name}_scale")
            if not 0 < scale < inf:
                raise UsageError(f"the scale of the map {name} is {scale:g}, expected a number above 0")

    def as_dict(self) -> dict[str, Any]:
        """Return the options as JSON values."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> InferOptions:
        """Return the options that `as_dict` wrote. Raises TypeError for an unknown name, UsageError as above."""
        given: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
        }
        return cls(**given)

    @property
    def method_options(self) -> MethodOptions:
        """The part of the options that concerns the method."""
        return MethodOptions(self.weights, device=self.device, precision=self.precision)

    def check_files(self) -> None:
        """See Reading. Raise UsageError, too, if a package that the options need is not installed."""
        super().check_files()
        check_exr(self.formats)
