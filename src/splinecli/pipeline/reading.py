"""How a capture is read, as one frozen record that `infer` and `info` share."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from splinecli.capture import CaptureSource, RadiometricCalibration, open_capture
from splinecli.capture.layouts.capture_files import check_not_empty, list_images
from splinecli.capture.lights.found_lights import ESTIMATE, FirstLight, LightFinder
from splinecli.capture.lights.lamp_files import LampOptions
from splinecli.capture.lights.light_frames import parse_light_frame
from splinecli.capture.lights.light_rows import LightForm
from splinecli.capture.paths import check_file
from splinecli.capture.reader import EQUAL
from splinecli.capture.restore.white_level import check_white_level
from splinecli.capture.window import parse_window
from splinecli.errors import UsageError, check_one_of
from splinecli.maths.transfer import AUTOMATIC, parse_transfer


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Which files make a capture, and how they are read: options of `infer` and `info`, as their help describes them.

    None is the default in the help. Raises UsageError.
    """

    lights: str | None = None
    first_light: FirstLight | None = None
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
            check_one_of("first light", self.first_light, get_args(FirstLight))
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
            from splinecli.light.unknown_lights import find_lights

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
