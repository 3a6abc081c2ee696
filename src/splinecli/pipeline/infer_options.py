"""The options of `infer`, as one frozen record that can be written as JSON and pickled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from splinecli.errors import UsageError
from splinecli.exr import check_exr
from splinecli.methods import DEFAULT_METHOD, MethodOptions, check_method
from splinecli.normals import Convention
from splinecli.pipeline.surface import check_pixel_size
from splinecli.transfer import AUTOMATIC, parse_transfer

if TYPE_CHECKING:
    from splinecli.capture import CaptureSource, RadiometricCalibration
    from splinecli.capture.lights.lamp_files import LampOptions

Device = Literal["auto", "cpu", "cuda"]
LightForm = Literal["xyz", "azel"]
Precision = Literal["auto", "float32", "bfloat16"]


@dataclass(frozen=True, kw_only=True)
class InferOptions:
    """How `infer` reads a capture, estimates its normals, and what it writes.

    Two records are equal if they give the same results. `output` and `device` do not count.

    Args:
        lights, mask, ground_truth: files that replace those of the capture.
        intensities: a file of light intensities, or "equal".
        lights_format: xyz for vectors, azel for azimuth and elevation in degrees.
        light_frame: the frame of the light file, such as "x-left,y-down". None for x right, y up, z to the camera.
        strict: fail where a warning says that the lights or images are probably wrong.
        light_positions, light_distance, pixel_size, object_width, camera_matrix: near lamps; see LampOptions.
            With `surface`, pixel_size is in millimetres and scales the surface, too.
        refine_lights: refine rough light directions.
        auto_mask: find the object where the capture has no mask.
        crop: the box X,Y,W,H of the images that is read; None for whole images.
        scale: 1/N to read one of N rows and columns; None for all.
        transfer: the curve of the images: auto, linear, srgb or gamma:G.
        ambient: an image without any of the lights.
        flat_field: a folder of images of an evenly white surface.
        white_level: stored value from which a pixel counts as saturated, such as 4095. None to find it.
        as_stored: use the stored values alone. By default, saturated pixels are restored and unknown light
            intensities are estimated.
        n_lights, seed: use this many lights, drawn with this seed. None for all lights.
        light_indices: use these lights, counted from 0.
        method: a name that `splinecli.methods.method_names` lists.
        weights: a shipped name or a file. None for the method's own.
        distil: learn the network on a sample of the pixels; False for the network on every pixel, None for the faster.
        output: results go to `output`/<capture name>/.
        formats: names of `splinecli.results.files.NORMALS`. With exr, albedo and depth are EXR files, too.
        maps: names of `splinecli.results.files.MAPS`.
        html: also write page.html. surface: also write the depth map and the mesh.
        convention: direction of the green channel in PNG files.

    Raises:
        UsageError: a value is unknown, or two options contradict each other.
    """

    lights: str | None = None
    intensities: str | None = None
    light_positions: str | None = None
    light_distance: float | None = None
    pixel_size: float | None = None
    object_width: float | None = None
    camera_matrix: str | None = None
    refine_lights: bool = False
    mask: str | None = None
    auto_mask: bool = False
    crop: str | None = None
    scale: str | None = None
    ground_truth: str | None = None
    light_frame: str | None = None
    lights_format: LightForm = "xyz"
    transfer: str = AUTOMATIC
    ambient: str | None = None
    flat_field: str | None = None
    white_level: float | None = None
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
    html: bool = False
    surface: bool = False
    convention: Convention = "opengl"
    strict: bool = False

    def __post_init__(self) -> None:
        from splinecli.capture.lights.draws import check_draw_settings
        from splinecli.capture.lights.light_frames import parse_light_frame
        from splinecli.capture.record import check_light_indices
        from splinecli.capture.restore.white_level import check_white_level
        from splinecli.capture.window import parse_window
        from splinecli.results.files import MAPS, NORMALS

        if self.n_lights is not None and self.light_indices is not None:
            raise UsageError("--n-lights and --light-indices contradict each other", hint="Leave one out")
        if self.mask is not None and self.auto_mask:
            raise UsageError("--mask and --auto-mask contradict each other", hint="Leave one out")
        _ = self.lamps, parse_window(self.crop, self.scale)
        check_method(self.method)
        check_pixel_size(self.pixel_size if self.surface else None)
        if self.n_lights is not None:
            check_draw_settings(self.n_lights, 1, self.seed)
        if self.light_indices is not None:
            check_light_indices(self.light_indices, max(self.light_indices, default=0) + 1)
        parse_transfer(self.transfer)
        parse_light_frame(self.light_frame)
        check_white_level(self.white_level)
        _check_one_of("precision", self.precision, get_args(Precision))
        _check_one_of("light format", self.lights_format, get_args(LightForm))
        _check_one_of("device", self.device, get_args(Device))
        _check_one_of("convention", self.convention, get_args(Convention))
        for name in self.formats:
            _check_one_of("format", name, NORMALS)
        for name in self.maps:
            _check_one_of("map", name, MAPS)

    def as_dict(self) -> dict[str, Any]:
        """Return the options as JSON values."""
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()
        }

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

    @property
    def lamps(self) -> LampOptions:
        """The part of the options that concerns near lamps. Raises UsageError."""
        from splinecli.capture.lights.lamp_files import LampOptions

        return LampOptions(
            positions=self.light_positions,
            distance=self.light_distance,
            pixel_size=self.pixel_size,
            scales_surface=self.surface,
            object_width=self.object_width,
            camera_matrix=self.camera_matrix,
        )

    def check_files(self) -> None:
        """Raise InputError if a file that the options name does not exist, or --flat-field contains no images.

        Raise UsageError if a package that the options need is not installed.
        """
        from splinecli.capture.paths import check_file
        from splinecli.capture.reader import EQUAL

        intensities = None if self.intensities == EQUAL else self.intensities
        named = (self.lights, self.light_positions, intensities, self.camera_matrix, self.mask)
        for name in (*named, self.ground_truth, self.ambient):
            if name is not None:
                check_file(Path(name), "a file", pipe=name == self.lights)
        self.radiometric_calibration()
        check_exr(self.formats)

    def radiometric_calibration(self) -> RadiometricCalibration:
        """Return how the images' values become linear light. Raises InputError."""
        from splinecli.capture import RadiometricCalibration
        from splinecli.capture.layouts.image_lists import check_not_empty, list_images

        flats: tuple[Path, ...] = ()
        if self.flat_field is not None:
            folder = Path(self.flat_field)
            flats = tuple(list_images(folder, leave_out_stems=("ambient", "mask"), leave_out=()))
            check_not_empty(flats, folder)
        dark = None if self.ambient is None else Path(self.ambient)
        return RadiometricCalibration(parse_transfer(self.transfer), dark, flats, self.transfer == AUTOMATIC)

    def open(self, folder: Path) -> CaptureSource:
        """Open the capture in the folder under these options. Raises InputError."""
        from splinecli.capture import open_capture
        from splinecli.capture.lights.light_frames import parse_light_frame
        from splinecli.capture.window import parse_window

        return open_capture(
            folder,
            lights=self.lights,
            intensities=self.intensities,
            mask=self.mask,
            ground_truth=self.ground_truth,
            radiometry=self.radiometric_calibration(),
            white_level=self.white_level,
            light_frame=parse_light_frame(self.light_frame),
            lights_format=self.lights_format,
            lamps=self.lamps,
            window=parse_window(self.crop, self.scale),
        )


def _check_one_of(what: str, value: str, allowed: Mapping[str, Any] | tuple[str, ...]) -> None:
    if value not in allowed:
        raise UsageError(f"no {what} named {value!r}; expected one of {', '.join(allowed)}")
