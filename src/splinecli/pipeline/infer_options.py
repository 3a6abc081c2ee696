"""The options of `infer`, `watch` and `info` as frozen records, which can be pickled and converted
to JSON.
"""

# Each option has a name and a type, then its panel, its help text and the kind of its value.
from __future__ import annotations

import dataclasses
import json
import math
import re
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from msgspec import NODEFAULT, Meta

from splinecli.capture import CaptureOptions, CaptureSource, RadiometricCalibration, open_capture
from splinecli.capture.files import check_not_empty, list_images
from splinecli.capture.formats.numbers import to_number
from splinecli.capture.lamp_files import LampOptions
from splinecli.capture.light_files import light_suffixes
from splinecli.capture.light_rows import EXCHANGED, LightForm, parse_light_frame
from splinecli.capture.light_search import NoLightsError
from splinecli.capture.linearise import parse_window
from splinecli.capture.reader import EQUAL
from splinecli.capture.record import ESTIMATE, SIDES_DEG, azimuth_of, check_light_indices
from splinecli.errors import UsageError
from splinecli.estimate.methods import DEFAULT_METHOD, MethodOptions, check_method, method_names
from splinecli.images.alignment import MIN_IMAGES
from splinecli.lights.light_fit import FEWEST_TO_REFINE
from splinecli.maths.normals import Convention
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.maths.transfer import AUTOMATIC, parse_transfer
from splinecli.pipeline.folder_settings import SETTINGS, read_settings, with_settings
from splinecli.recipe.work import RecipeOptions
from splinecli.records import base as records
from splinecli.records.base import (
    NEAR,
    SPECIAL,
    FileName,
    NotNegative,
    Option,
    Positive,
    Record,
    Seed,
    flag,
    option,
)
from splinecli.records.capture_warnings import SETTINGS_READ, CaptureWarning
from splinecli.records.output_files import MAPS, NORMALS
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.surface_files import check_exr
from splinecli.system.files import check_file
from splinecli.system.machine import Device, Precision, count_available_cores

Redo = Literal["nothing", "changed", "all"]
SMALLEST_PIXEL_MM, LARGEST_PIXEL_MM = 1e-6, 1e6

# Options shared by several commands.


def complete_weights() -> list[str]:
    """Return the names of the shipped weights, or none if the shell should complete file names."""
    # The module that normally reads this file imports torch, which is too slow for completion.
    return list(
        json.loads((resources.files("splinecli") / "assets/weights.json").read_text("utf-8"))
    )


CURVES = ("auto", "linear", "srgb", "gamma:2.2")  # the last is an example
OUTPUT = "--output -o"
LEAVE_ONE = "Leave one out"
MASK_IMAGE = "Mask image, white on the {} (above half of its largest value)."
DISCONTINUITY_HELP = "Discontinuity sensitivity of the surface; 0 gives a continuous surface."

AutoMask = Annotated[
    bool,
    Option("Input", "If there is no mask, find the object in the images and write found_mask.png."),
]
AsStored = Annotated[
    bool,
    Option(
        "Input",
        "Use the stored values and the given lights: correct nothing, and do not remove lens blur,"
        " restore saturated pixels or estimate light intensities.",
    ),
]
GivenWhiteLevel = Annotated[
    Positive | None,
    Option(
        SPECIAL,
        "Stored value from which a pixel is considered saturated.",
        "N",
        "found in the images",
    ),
]
RandomSeed = Annotated[Seed, Option("Lights", "Seed of the random draws.", "S")]
RefineLights = Annotated[
    bool, Option("Lights", "Refine rough light directions so that they fit the images better.")
]
Weights = Annotated[
    str | None,
    Option(
        "Method",
        "Weights: a file, or a shipped name.",
        "FILE",
        "the method's own",
        complete=complete_weights,
    ),
]
DeviceName = Annotated[
    Device,
    Option(
        "Speed",
        "cpu, cuda (a GPU), or auto: the GPU if there is one.",
        "DEVICE",
    ),
]
PrecisionName = Annotated[
    Precision,
    Option(
        "Speed",
        "float32, bfloat16, or auto: bfloat16 if the hardware computes faster in it.",
        "FORMAT",
    ),
]
Quiet = Annotated[bool, Option("Output", "Print nothing but errors.", names="--quiet -q")]
Overwrite = Annotated[bool, Option("Output", "Replace earlier results.")]
Update = Annotated[
    bool, Option("Output", "Compute changed captures again, and skip those that are done.")
]


class Display(Record, frozen=True, kw_only=True):
    """How a command prints its output."""

    as_json: bool = flag(
        "Output", "Print one JSON document on stdout, and nothing else.", names="--json"
    )
    quiet: Quiet = False


def parse_workers(text: str) -> int:
    """Return the number of processes, which is 0 for "auto". Raises UsageError."""
    if text != "auto" and (not text.isdecimal() or len(text) > 4 or int(text) < 1):
        raise UsageError(f"--workers is {text!r}; expected a number of at least 1, or auto")
    return 0 if text == "auto" else int(text)


class WorkerOptions(Record, frozen=True, kw_only=True):
    """The number of local processes for the items of a command; 0 uses as many as the machine can
    run.
    """

    workers: int = option(
        "Processes and machines",
        "Number of parallel processes on this machine, or auto to choose by cores and memory"
        " (needs the extra 'cluster').",
        "N",
        value=1,
        parse=parse_workers,
    )


class ClusterOptions(WorkerOptions, frozen=True, kw_only=True):
    """Where the items of a command are processed: in this process, in other processes or on a
    cluster.
    """

    # address or scheduler file of a Dask scheduler
    address: str | None = option(
        "Processes and machines",
        "Compute on a running Dask cluster: the address of its scheduler, or its scheduler file"
        " (needs the extra 'cluster').",
        "ADDRESS",
        names="--cluster",
    )
    gpu: bool = False  # whether only workers with the Dask resource GPU are used

    CONFLICTS = (("workers", "address", "Leave --workers out, as the cluster has its own workers"),)

    def on_cores(self, n_items: int | None = None) -> ClusterOptions | None:
        """Return these options with one process per core instead of 0, and at most one per item.

        None if other processes would not be faster than this one.
        """
        if self.address is not None:
            return self
        workers = self.workers or count_available_cores()
        if n_items is not None:
            workers = min(workers, n_items)
        return None if workers < 2 else self.replace(workers=workers)


HERE = ClusterOptions()


class ReadingOptions(Record, frozen=True, kw_only=True):
    """The options of `infer` and `info` that select the files of a capture and how they are read.

    Each option is described in the help. None stands for the default given there. Raises
    UsageError.
    """

    mask: FileName | None = option(
        "Input", MASK_IMAGE.format("object"), "FILE", "a file named mask.*, or all pixels"
    )
    crop: str | None = option(
        "Input", "Read this box of the images: upper left corner and size, in pixels.", "X,Y,W,H"
    )
    scale: str | None = option(
        "Input", "Read every N-th row and column, for a first look.", "1/N", "all"
    )
    align: bool = flag(
        "Input",
        "Align the images to one of them, if they were shifted, rotated or zoomed between"
        " exposures.",
    )
    ground_truth: FileName | None = option(
        SPECIAL, "True normals to compare with (.mat, .npy, text, PNG, TIFF).", "FILE"
    )
    transfer: str = option(
        "Input",
        "Transfer curve of the images: auto, linear, srgb or gamma:G. auto follows the files, and"
        " reads JPEG as sRGB.",
        "CURVE",
        value=AUTOMATIC,
        complete=CURVES,
    )
    ambient: FileName | None = option(
        "Input", "Image taken without the lights, to subtract from all images.", "FILE", "ambient.*"
    )
    flat_field: FileName | None = option(
        SPECIAL,
        "Folder with images of a uniform white surface: one for all lights, or one for each light.",
        "DIR",
    )
    white_level: GivenWhiteLevel = None
    lights: FileName | None = option(
        "Lights",
        f"File of the light directions ({light_suffixes()}): x y z for each image, z to the camera."
        " Or the word estimate: derive them from the images, less accurately than a calibration.",
        "FILE",
        "the light file in CAPTURE",
    )
    first_light: str | None = option(
        "Lights",
        "With --lights estimate: side that the first light comes from, such as left, above or"
        " upper-left, or its azimuth in degrees, counter-clockwise from the right. Needed if the"
        " images show no outline of the object.",
        "SIDE",
        complete=tuple(SIDES_DEG),
    )
    light_frame: str | None = option(
        "Lights",
        f"Frame of the light file: any of x-left, y-down, z-away and {EXCHANGED} (y comes before"
        " x).",
        "LIST",
        "x right, y up, z to the camera",
        complete=records.complete_list(("x-left", "y-down", "z-away", EXCHANGED)),
    )
    light_format: LightForm = option(
        SPECIAL,
        "Form of a light in a text file: xyz, a vector; azel, azimuth and elevation; or"
        " slant-tilt, the angles of HALCON. Angles are in degrees.",
        "FORM",
        value="xyz",
    )
    intensities: FileName | None = option(
        "Lights",
        "File of the light intensities: a line r g b for each image. Or the word equal, or estimate"
        " to ignore the file in CAPTURE.",
        "FILE",
        "equal, or estimated if the images differ clearly",
    )
    lights_in_channels: bool = flag(
        SPECIAL,
        "The channels of a colour image are photographs of a gray object under three coloured"
        " lamps; the light file has three lights for each image, in the order R, G, B.",
    )
    crosstalk: FileName | None = option(
        SPECIAL,
        "With --lights-in-channels: responses of the channels R, G, B (lines) to the three lamps.",
        "FILE",
        "crosstalk.txt in CAPTURE, or none",
    )
    light_positions: FileName | None = option(
        NEAR,
        "Positions of near lamps: a line x y z for each image, in any unit, from the middle of the"
        " image.",
        "FILE",
        "light_positions.txt in CAPTURE",
    )
    light_distance: Positive | None = option(
        NEAR, "Distance of near lamps from the middle of the object.", "D"
    )
    pixel_size: Positive | None = option(
        NEAR,
        "Width of a pixel on the object, in the unit of the lamps.",
        "S",
        "pixel_size.txt in CAPTURE",
    )
    object_width: Positive | None = option(
        NEAR, "Width of the object in its mask, instead of --pixel-size.", "W"
    )
    camera_matrix: FileName | None = option(
        NEAR,
        "Text file of the 3 x 3 camera matrix in pixels, for a perspective camera.",
        "FILE",
        "camera_matrix.txt in CAPTURE, or orthographic",
    )
    strict: bool = flag(
        "Output",
        "Fail with exit code 3 if the lights or the images are probably wrong, instead of warning"
        " or correcting them.",
    )
    # whether a surface in the unit of pixel_size is computed, too; a field of InferOptions
    surface = False

    CONFLICTS: ClassVar[records.Conflicts] = (
        ("lights_in_channels", "align", LEAVE_ONE),
        ("light_positions", "light_distance", LEAVE_ONE),
        ("pixel_size", "object_width", LEAVE_ONE),
        *(
            (f"lights={ESTIMATE}", name, "Leave one out, or pass a light file")
            for name in ("light_positions", "light_distance", "light_frame", "light_format")
        ),
        ("lights", "light_positions", LEAVE_ONE),
        ("align", "scale", "Leave one out, or use --crop for a first look"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        add_it = "Add {}, or leave both out"
        if self.crosstalk is not None and not self.lights_in_channels:
            hint = add_it.format("--lights-in-channels")
            raise UsageError("--crosstalk needs --lights-in-channels", hint=hint)
        if self.first_light is not None:
            if not (self.finds_lights or self.may_find_lights):
                hint = add_it.format("--lights estimate")
                raise UsageError("--first-light needs --lights estimate", hint=hint)
            azimuth_of(self.first_light)
        _ = self.lamps, parse_window(self.crop, self.scale), parse_transfer(self.transfer)
        if "exchanged" in (self.light_frame or ""):  # its name in earlier versions
            raise UsageError(f"--light-frame is {self.light_frame!r}; exchanged is now {EXCHANGED}")
        parse_light_frame(self.light_frame)

    @property
    def finds_lights(self) -> bool:
        """Whether the lights are estimated from the images."""
        return self.lights == ESTIMATE

    @property
    def light_file(self) -> str | None:
        """The light file that replaces the capture's own."""
        return None if self.finds_lights else self.lights

    @property
    def lamps(self) -> LampOptions:
        """The options for near lamps. Raises UsageError."""
        return LampOptions(
            positions=self.light_positions,
            distance=self.light_distance,
            pixel_size=self.pixel_size,
            scales_surface=self.surface,
            object_width=self.object_width,
            camera_matrix=self.camera_matrix,
        )

    def check_files(self) -> None:
        """Raise InputError if a file is missing, or if the folder of --flat-field contains no
        images.
        """
        intensities = None if self.intensities in (EQUAL, ESTIMATE) else self.intensities
        for name in (
            *(self.light_file, self.light_positions, intensities, self.camera_matrix),
            *(self.mask, self.crosstalk, self.ground_truth, self.ambient),
        ):
            if name is not None:
                words = (ESTIMATE, EQUAL)  # in place of some of the files
                check_file(Path(name), "a file", pipe=name == self.light_file, words=words)
        self.radiometric_calibration()

    def radiometric_calibration(self) -> RadiometricCalibration:
        """Return the conversion of image values to linear light. Raises InputError."""
        flats: tuple[Path, ...] = ()
        if self.flat_field is not None:
            folder = Path(self.flat_field)
            flats = tuple(list_images(folder, leave_out_stems=("ambient", "mask"), leave_out=()))
            check_not_empty(flats, folder)
        dark = None if self.ambient is None else Path(self.ambient)
        automatic = self.transfer == AUTOMATIC
        return RadiometricCalibration(parse_transfer(self.transfer), dark, flats, automatic)

    @property
    def recipe(self) -> RecipeOptions:
        """How the recipe prepares the capture."""
        return RecipeOptions(
            align=self.align,
            finds_lights=self.finds_lights,
            first_light=self.first_light,
            strict=self.strict,
            mends=not self.strict,
            keeps_lights=self.light_frame is not None,
        )

    @property
    def may_find_lights(self) -> bool:
        """Whether the lights are estimated if the capture has none.

        They are not if an option refers to given lights, or with --strict.
        """
        about_lights = (
            self.lights,
            self.light_frame,
            self.light_positions,
            self.light_distance,
            self.strict or None,
            self.lights_in_channels or None,
        )
        return self.light_format == "xyz" and all(each is None for each in about_lights)

    def open(self, folder: Path) -> CaptureSource:
        """Open the capture in the folder with these options.

        If the capture has no lights, they remain to be estimated. Raises InputError, or UsageError
        if --first-light is given although the capture has a light file.
        """
        try:
            source = self._open(folder, needs_lights=not self.finds_lights)
        except NoLightsError:
            if not self.may_find_lights:
                raise
            source = self._open(folder, needs_lights=False)
            if source.n_lights < FEWEST_TO_REFINE:
                raise
        if source.has_lights and self.first_light is not None:
            raise UsageError(
                f"--first-light applies to estimated lights, but {source.name} has a light file",
                hint="Add --lights estimate, or leave --first-light out",
            )
        taken = [
            f"{name.replace('_', '-')} = {json.dumps(value)}"
            for name, value in read_settings(folder, FolderSettings).items()
            if getattr(self, name, None) == value
        ]
        if taken:
            note = CaptureWarning(SETTINGS_READ, f"{SETTINGS} sets {', '.join(taken)}.")
            source = dataclasses.replace(source, warnings=(*source.warnings, note))
        return source

    def with_settings(self, folder: Path) -> Self:
        """Return these options, with values from splinecli.toml in the folder instead of defaults.

        Raises InputError, or UsageError if options conflict.
        """
        merged = with_settings(self, folder, FolderSettings)
        if merged != self:
            merged.check_files()
        return merged

    def _open(self, folder: Path, *, needs_lights: bool) -> CaptureSource:
        return open_capture(
            folder,
            CaptureOptions(
                lights=self.light_file,
                intensities=self.intensities,
                mask=self.mask,
                ground_truth=self.ground_truth,
                radiometry=self.radiometric_calibration(),
                white_level=self.white_level,
                light_frame=parse_light_frame(self.light_frame),
                light_format=self.light_format,
                lamps=self.lamps,
                window=parse_window(self.crop, self.scale),
                needs_lights=needs_lights,
                lights_in_channels=self.lights_in_channels,
                crosstalk=self.crosstalk,
            ),
        )


class FolderSettings(ReadingOptions, frozen=True, kw_only=True):
    """The options that splinecli.toml may contain, without those for output and methods."""

    auto_mask: AutoMask = False

    CONFLICTS = (*ReadingOptions.CONFLICTS, ("mask", "auto_mask", LEAVE_ONE))


def parse_indices(text: str, title: str) -> tuple[int, ...]:
    """Return the integers in a text such as "0,5,12". Raises UsageError."""
    try:
        return tuple(int(item) for item in text.split(","))
    except ValueError:
        raise UsageError(
            f"{title} is {text!r}; expected zero-based numbers such as 0,5,12"
        ) from None


class InferOptions(ReadingOptions, frozen=True, kw_only=True):
    """The options of `infer`; see its help.

    Raises UsageError if a value is invalid or two options conflict.
    """

    # light_indices are zero-based. map_scales contains names of maps with the values shown as
    # white, if they differ from MAPS.
    auto_mask: AutoMask = False
    as_stored: AsStored = False
    refine_lights: RefineLights = False
    pixel_size: Positive | None = option(
        NEAR,
        "Width of a pixel on the object, in the unit of the lamps. With"
        " --surface: in millimetres, for a surface in millimetres.",
        "S",
        "pixel_size.txt in CAPTURE",
    )
    n_lights: Annotated[int, Meta(ge=MIN_LIGHTS)] | None = option(
        "Lights", "Use K lights drawn at random.", "K", "all"
    )
    seed: RandomSeed = 0
    light_indices: tuple[int, ...] | None = option(
        SPECIAL,
        "Use these lights, counted from 0. Plots and warnings count from 1.",
        "I,J,...",
        parse=partial(parse_indices, title="--light-indices"),
    )
    method: str = option(
        "Method",
        f"Method to use: {records.listed(method_names())}.",
        "METHOD",
        value=DEFAULT_METHOD,
        complete=method_names(),
    )
    weights: Weights = None
    distil: bool | None = option(
        "Speed",
        "Approximate the network with a smaller one, trained on a sample of the capture's pixels,"
        " or apply it to every pixel.",
        default="--distil from 100,000 pixels",
        names="--distil/--exact",
    )
    device: DeviceName = "auto"
    precision: PrecisionName = "auto"
    output: FileName = option(
        "Output", "Write results to OUT/<capture name>/.", "OUT", value="out", names=OUTPUT
    )
    formats: tuple[str, ...] = option(
        "Output",
        f"Files of the normal map: any of {records.listed(NORMALS)}. png has 16 bits, png8 has 8;"
        " the others are float32. exr (needs the extra 'exr') also applies to albedo and depth.",
        "LIST",
        value=("png", "npy"),
        names="--format",
        items=NORMALS,
    )
    maps: tuple[str, ...] = option(
        "Output",
        f"Further maps: any of {records.listed(MAPS)}. preview is a shaded image. relief:2 makes"
        " heights of 2 pixels white in the picture, curvature:0.1 a curvature of 0.1 per pixel.",
        "LIST",
        value=(),
        items=MAPS,
    )
    map_scales: tuple[tuple[str, Positive], ...] = ()
    html: bool = flag("Output", "Also write page.html for interactive relighting, with all maps.")
    surface: bool = flag(
        "Output", "Also write mesh.glb, mesh.ply, and depth.npy, .tiff and .png, as integrate does."
    )
    discontinuity: NotNegative = option(SPECIAL, DISCONTINUITY_HELP, "K", value=DISCONTINUITY)
    convention: Convention = option(
        SPECIAL,
        "Green channel of the PNG files: opengl is y up, directx is y down.",
        "NAME",
        value="opengl",
    )

    CONFLICTS = (
        *FolderSettings.CONFLICTS,
        ("n_lights", "light_indices", LEAVE_ONE),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        count = self.n_lights if self.light_indices is None else len(self.light_indices)
        if self.align and count is not None and count < MIN_IMAGES:
            name = "--n-lights" if self.light_indices is None else "--light-indices"
            raise UsageError(
                f"{name} leaves {count} images, but --align needs at least {MIN_IMAGES}",
                hint="Use more lights, or leave --align out",
            )
        if self.finds_lights and self.refine_lights:
            raise UsageError(
                "--lights estimate already refines the lights that it finds",
                hint="Leave --refine-lights out",
            )
        check_method(self.method)
        if self.surface and self.pixel_size is not None:
            check_pixel_size(self.pixel_size)
        if self.light_indices is not None:
            check_light_indices(self.light_indices, max(self.light_indices, default=0) + 1)

    @classmethod
    def from_arguments(cls, given: dict[str, Any]) -> Self:
        """Return the options for arguments from the command line; see Record.

        --maps also sets scales, and the seed is kept only if the lights are drawn at random.
        """
        scales = []
        if given["maps"] is not None:
            scaled = [row.name for row in MAPS.values() if row.scale is not None]
            names = []
            for item in given["maps"].split(","):
                name, colon, scale = (part.strip() for part in item.partition(":"))
                names.append(name)
                if colon and (name not in scaled or not 0 < (to_number(scale) or 0) < math.inf):
                    expected = " or ".join(f"{name}:NUMBER" for name in scaled)
                    problem = f"--maps contains {item.strip()!r}; expected a scale as in {expected}"
                    raise UsageError(f"{problem}, above 0")
                scales += [(name, float(scale))] if colon else []
            given["maps"] = ",".join(names)
        if given["n_lights"] is None:
            given["seed"] = None
        return super().from_arguments(given).replace(map_scales=tuple(scales))

    def changes(self, earlier: InferOptions) -> list[str]:
        """Return the options whose values affect the results and differ from earlier options.

        --output and --device do not affect the results.
        """
        found = {}
        for name, kind in records.field_types(type(self)).items():
            if name not in ("output", "device") and getattr(self, name) != getattr(earlier, name):
                given = records.option_of(kind)
                found[records.long_name(name, given) if given else "--maps"] = True
        return list(found)

    @property
    def may_find_lights(self) -> bool:
        return super().may_find_lights and not self.refine_lights

    @property
    def recipe(self) -> RecipeOptions:
        return dataclasses.replace(
            super().recipe,
            as_stored=self.as_stored,
            asks_network=self.method.startswith(DEFAULT_METHOD) and not self.as_stored,
            mends=not (self.as_stored or self.strict),
            auto_mask=self.auto_mask,
            refine_lights=self.refine_lights,
        )

    @property
    def method_options(self) -> MethodOptions:
        """The options for the method."""
        return MethodOptions(self.weights, device=self.device, precision=self.precision)

    def check_files(self) -> None:
        """Raise the errors of ReadingOptions, and UsageError if a required package is not
        installed.
        """
        super().check_files()
        check_exr(self.formats)


def check_pixel_size(pixel_size: float) -> None:
    """Raise UsageError if a pixel size in millimetres is out of range for a surface."""
    if not SMALLEST_PIXEL_MM <= pixel_size <= LARGEST_PIXEL_MM:
        expected = f"{SMALLEST_PIXEL_MM:g} to {LARGEST_PIXEL_MM:g}"
        raise UsageError(f"the pixel size is {pixel_size:g} mm, expected {expected}")


class Shard(NamedTuple):
    """Part `number` of a batch of `n_parts`, counted from 1."""

    number: int
    n_parts: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Return the shard for a text such as "3/8". Raises UsageError."""
        found = re.fullmatch(r"([0-9]{1,18})/([0-9]{1,18})", text)
        if found is None:
            raise UsageError(
                f"--shard is {text!r}; expected I/N, such as 3/8 for the third of eight parts"
            )
        number, count = int(found[1]), int(found[2])
        if not 1 <= number <= count:
            raise UsageError(
                f"--shard is {number}/{count}; expected I/N with I from 1 to N",
                hint="If your job numbers start at 0, add 1",
            )
        return cls(number, count)


class BatchOptions(Record, frozen=True, kw_only=True):
    """The captures of `infer`, which of them are computed again, and what is printed."""

    captures: tuple[Path, ...] = option(
        "Arguments",
        "Folders with the images of one object each, or videos.",
        "CAPTURE",
        value=NODEFAULT,
    )
    shard: Shard | None = option(
        "Processes and machines",
        "Process shard I of N: captures I, I+N, I+2N, ...",
        "I/N",
        parse=Shard.parse,
    )
    update: Update = False
    overwrite: Overwrite = False
    as_json: bool = flag(
        "Output", "Print a JSON list of the reports on stdout, and nothing else.", names="--json"
    )
    as_json_lines: bool = flag(
        "Output",
        "Print each report as one line of JSON on stdout as soon as its capture is done.",
        names="--jsonl",
    )
    quiet: Quiet = False

    CONFLICTS = (("as_json", "as_json_lines", LEAVE_ONE), ("overwrite", "update", LEAVE_ONE))

    @property
    def redo(self) -> Redo:
        """Which captures with existing results are computed again."""
        return "all" if self.overwrite else "changed" if self.update else "nothing"


class WatchOptions(Record, frozen=True, kw_only=True):
    """The options of `watch`; see its help."""

    folder: Path = option(
        "Arguments",
        "Folder in which captures arrive, each as a subfolder or a video.",
        "FOLDER",
        value=NODEFAULT,
    )
    options: tuple[str, ...] = option(
        "Arguments", "Options of infer, after two dashes.", "-- OPTIONS", value=()
    )
    marker: str | None = option(
        "Captures", "File that appears in a subfolder when it is complete.", "NAME", "see --settle"
    )
    settle: NotNegative = option(
        "Captures",
        "A video, or a subfolder without --marker, is complete when it has not changed for this"
        " long.",
        "SECONDS",
        value=5.0,
    )


class InfoOptions(Display, frozen=True, kw_only=True):
    """The options of `info` in addition to ReadingOptions; see its help."""

    capture: Path = option(
        "Arguments", "Folder with the images of one object, or a video.", "CAPTURE", value=NODEFAULT
    )
    auto_mask: bool = flag("Input", "If there is no mask, find the object in the images.")
    check_lights: bool = flag(
        "Lights",
        "List other readings of the light file, and how well each one fits the images.",
    )
    mended_lights: Path | None = option(
        "Lights",
        "If the light directions fit the images better in another order or frame, write the"
        " corrected ones.",
        "FILE",
    )
    plot: Path | None = option("Output", "Also plot the light directions to a PNG file.", "FILE")
    write_settings: bool = flag(
        "Output", "Save the given options for reading the capture in CAPTURE/splinecli.toml."
    )
    output: FileName | None = option(
        "Output",
        "Write OUT/<capture name>/capture.png, a contact sheet of the images with their lights.",
        "OUT",
        names=OUTPUT,
    )
    overwrite: bool = flag("Output", "Replace an earlier plot or file of lights.")
