"""The options of `infer`, `watch` and `info` as frozen records, which can be pickled and converted
to JSON.
"""

# The options form a table: name, type, panel and kind of value, then the help text.
from __future__ import annotations

import dataclasses
import json
import math
import re
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from msgspec import Meta

from splinecli.capture import CaptureSource, RadiometricCalibration, open_capture
from splinecli.capture.files import check_not_empty, list_images
from splinecli.capture.formats.numbers import to_number
from splinecli.capture.light_files import light_suffixes
from splinecli.capture.light_rows import EXCHANGED, LightForm, parse_light_frame
from splinecli.capture.linearise import parse_window
from splinecli.capture.near_lamps import LampOptions
from splinecli.capture.reader import EQUAL
from splinecli.capture.record import (
    ESTIMATE,
    SIDES_DEG,
    azimuth_of,
    check_light_indices,
)
from splinecli.errors import UsageError
from splinecli.estimate.methods import DEFAULT_METHOD, MethodOptions, check_method, method_names
from splinecli.images.alignment import MIN_IMAGES
from splinecli.maths.normals import Convention
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.maths.transfer import AUTOMATIC, parse_transfer
from splinecli.recipe.work import RecipeOptions
from splinecli.records import base as records
from splinecli.records.base import FileName, NotNegative, Option, Positive, Record, Seed
from splinecli.records.output_files import MAPS, NORMALS
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.surface_files import check_exr
from splinecli.system.files import check_file
from splinecli.system.machine import Device, Precision, count_available_cores

Redo = Literal["nothing", "changed", "all"]
SMALLEST_PIXEL_MM, LARGEST_PIXEL_MM = 1e-6, 1e6

# Options shared by several commands.


def complete_weights() -> list[str]:
    """Return the names of the shipped weights. If none starts with the typed text, the shell
    completes file names.
    """
    # The module that usually reads this file imports torch, which is too slow for shell completion.
    return list(
        json.loads((resources.files("splinecli") / "assets/weights.json").read_text("utf-8"))
    )


CURVES = ("auto", "linear", "srgb", "gamma:2.2")  # the last is an example
OUTPUT = ("--output", "-o")
MASK_IMAGE = "Mask image, white on the {} (above half of its largest value)."
DISCONTINUITY_HELP = "Discontinuity sensitivity of the surface; 0 gives a continuous surface."

AsStored = Annotated[
    bool,
    Option(
        "Input",
        "",
        "Use the stored values: do not remove lens blur, restore saturated pixels or estimate"
        " light intensities.",
    ),
]
WhiteLevel = Annotated[
    Positive | None,
    Option(
        "Input",
        "N",
        "Stored value from which a pixel is considered saturated.",
        default="found in the images",
    ),
]
RandomSeed = Annotated[Seed, Option("Lights", "S", "Seed of the random draws.")]
RefineLights = Annotated[
    bool, Option("Lights", "", "Refine rough light directions so that they fit the images better.")
]
Weights = Annotated[
    str | None,
    Option(
        "Method",
        "NAME|FILE",
        "Weights: a shipped name or a file.",
        default="the method's own",
        complete=complete_weights,
    ),
]
DeviceName = Annotated[
    Device,
    Option("Speed", "", "Device to compute on. auto is a CUDA GPU if there is one, else the CPU."),
]
PrecisionName = Annotated[
    Precision,
    Option(
        "Speed", "", "Number format. auto is bfloat16 if the hardware supports it, else float32."
    ),
]
Quiet = Annotated[bool, Option("Output", "", "Print nothing but errors.", names=("--quiet", "-q"))]
Overwrite = Annotated[bool, Option("Output", "", "Replace earlier results.")]
Update = Annotated[
    bool, Option("Output", "", "Compute changed captures again, and skip those that are done.")
]


class Display(Record, frozen=True, kw_only=True):
    """The output that a command prints."""

    as_json: Annotated[
        bool,
        Option(
            "Output", "", "Print one JSON document on stdout, and nothing else.", names=("--json",)
        ),
    ] = False
    quiet: Quiet = False


def parse_workers(text: str) -> int:
    """Return the number of processes, with 0 for "auto". Raises UsageError."""
    if text != "auto" and (not text.isdecimal() or len(text) > 4 or int(text) < 1):
        raise UsageError(f"--workers is {text!r}; expected a number of at least 1, or auto")
    return 0 if text == "auto" else int(text)


class Workers(Record, frozen=True, kw_only=True):
    """The number of local processes that work on the items of a command; 0 means as many as the
    machine can use.
    """

    workers: Annotated[
        int,
        Option(
            "Processes and machines",
            "N|auto",
            "Number of parallel processes on this machine (needs the extra 'cluster'). auto"
            " chooses by cores and memory.",
            parse=parse_workers,
        ),
    ] = 1


class ClusterOptions(Workers, frozen=True, kw_only=True):
    """Where the items of a command are processed: in this process, in other local processes, or on
    a Dask cluster.
    """

    # the address or the scheduler file of a Dask scheduler
    address: Annotated[
        str | None,
        Option(
            "Processes and machines",
            "ADDRESS|FILE",
            "Compute on the workers of a running Dask cluster: the address of its scheduler, or"
            " its scheduler file (needs"
            " the extra 'cluster').",
            names=("--cluster",),
        ),
    ] = None
    gpu: bool = False  # whether only workers with the Dask resource GPU are used

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address is not None and self.workers != 1:
            hint = "Leave --workers out: the cluster has workers of its own"
            raise UsageError("--workers and --cluster contradict each other", hint=hint)

    def on_cores(self, n_items: int | None = None) -> ClusterOptions | None:
        """Return these options with 0 replaced by one process per core, limited to one process per
        item.

        Return None if other processes would not be faster than this one.
        """
        if self.address is not None:
            return self
        workers = self.workers or count_available_cores()
        if n_items is not None:
            workers = min(workers, n_items)
        return None if workers < 2 else self.replace(workers=workers)


HERE = ClusterOptions()


class Reading(Record, frozen=True, kw_only=True):
    """The options of `infer` and `info` that select the files of a capture and how to read them.

    The help describes each option. None stands for the default given there. Raises UsageError.
    """

    mask: Annotated[
        FileName | None,
        Option(
            "Input",
            "FILE",
            MASK_IMAGE.format("object"),
            default="a file named mask.*, or all pixels",
        ),
    ] = None
    crop: Annotated[
        str | None,
        Option(
            "Input",
            "X,Y,W,H",
            "Read this box of the images: upper left corner and size, in pixels.",
        ),
    ] = None
    scale: Annotated[
        str | None,
        Option("Input", "1/N", "Read every N-th row and column, for a first look.", default="all"),
    ] = None
    align: Annotated[
        bool,
        Option(
            "Input",
            "",
            "Align the images to the first one, if they were shifted, rotated or zoomed between"
            " exposures.",
        ),
    ] = False
    ground_truth: Annotated[
        FileName | None,
        Option("Input", "FILE", "True normals to compare with (.mat, .npy, text, PNG, TIFF)."),
    ] = None
    transfer: Annotated[
        str,
        Option(
            "Input",
            "CURVE",
            "Transfer curve of the images: auto, linear, srgb or gamma:G. auto follows the files,"
            " and reads JPEG as sRGB.",
            complete=CURVES,
        ),
    ] = AUTOMATIC
    ambient: Annotated[
        FileName | None,
        Option(
            "Input",
            "FILE",
            "Image taken without the lights, to subtract from all images.",
            default="ambient.*",
        ),
    ] = None
    flat_field: Annotated[
        FileName | None,
        Option(
            "Input",
            "DIR",
            "Folder with images of a uniform white surface: one for all lights, or one for each"
            " light.",
        ),
    ] = None
    white_level: WhiteLevel = None
    lights: Annotated[
        FileName | None,
        Option(
            "Lights",
            "FILE|estimate",
            f"Light directions ({light_suffixes()}): x y z for each image, z to the camera."
            " estimate derives them from the"
            " images, less accurately than a calibration.",
            default="the light file in CAPTURE",
        ),
    ] = None
    first_light: Annotated[
        str | None,
        Option(
            "Lights",
            "SIDE|DEGREES",
            "With --lights estimate: the side that the first light comes from, such as left, above"
            " or upper-left, or its"
            " azimuth, counter-clockwise from the right. Needed if the images show no outline of"
            " the object.",
            complete=tuple(SIDES_DEG),
        ),
    ] = None
    light_frame: Annotated[
        str | None,
        Option(
            "Lights",
            "LIST",
            f"Frame of the light file: any of x-left, y-down, z-away and {EXCHANGED} (y comes"
            " before x).",
            default="x right, y up, z to the camera",
            complete=records.complete_list(("x-left", "y-down", "z-away", EXCHANGED)),
        ),
    ] = None
    light_format: Annotated[
        LightForm,
        Option(
            "Lights",
            "",
            "Form of a light in a text file: xyz, a vector; azel, azimuth and elevation; or"
            " slant-tilt, the angles of"
            " HALCON. Angles are in degrees.",
        ),
    ] = "xyz"
    intensities: Annotated[
        FileName | None,
        Option(
            "Lights",
            "FILE|equal",
            "Light intensities: a line r g b for each image.",
            default="equal, or estimated if the images show that they differ",
        ),
    ] = None
    lights_in_channels: Annotated[
        bool,
        Option(
            "Lights",
            "",
            "The channels of each colour image are photographs under three coloured lamps; the"
            " light file has three lights"
            " for each image, in the order R, G, B. For gray objects.",
        ),
    ] = False
    crosstalk: Annotated[
        FileName | None,
        Option(
            "Lights",
            "FILE",
            "With --lights-in-channels: 3 x 3 responses to the lamps, one line for each of the"
            " channels R, G, B.",
            default="crosstalk.txt in CAPTURE, or none",
        ),
    ] = None
    light_positions: Annotated[
        FileName | None,
        Option(
            "Lights",
            "FILE",
            "Near lamps: a line x y z for each image, in any unit, from the middle of the image.",
            default="light_positions.txt in CAPTURE",
        ),
    ] = None
    light_distance: Annotated[
        Positive | None,
        Option(
            "Lights", "D", "Near lamps: the distance of all lamps from the middle of the object."
        ),
    ] = None
    pixel_size: Annotated[
        Positive | None,
        Option(
            "Lights",
            "S",
            "Near lamps: the width of a pixel on the object.",
            default="pixel_size.txt in CAPTURE",
        ),
    ] = None
    object_width: Annotated[
        Positive | None,
        Option(
            "Lights",
            "W",
            "Near lamps: the width of the object in its mask, instead of --pixel-size.",
        ),
    ] = None
    camera_matrix: Annotated[
        FileName | None,
        Option(
            "Lights",
            "FILE",
            "Text file of the 3 x 3 camera matrix in pixels, for a perspective camera: each pixel"
            " is then estimated in the"
            " frame of its viewing ray.",
            default="camera_matrix.txt in CAPTURE, or orthographic",
        ),
    ] = None
    strict: Annotated[
        bool,
        Option(
            "Output",
            "",
            "Fail with exit code 3 if the lights or the images are probably wrong, instead of"
            " warning.",
        ),
    ] = False
    # whether a surface, in the unit of pixel_size, is also computed; a field of InferOptions
    surface = False

    def __post_init__(self) -> None:
        super().__post_init__()
        # These options apply to a light file or to near lamps.
        reasons = {
            "--light-positions": self.light_positions is not None and "finds distant lights",
            "--light-distance": self.light_distance is not None and "finds distant lights",
            "--light-frame": self.light_frame is not None and "needs no light file",
            "--light-format": self.light_format != "xyz" and "needs no light file",
        }
        for option, reason in reasons.items():
            if self.finds_lights and reason:
                problem = f"--lights estimate {reason}, so it contradicts {option}"
                raise UsageError(problem, hint=f"Leave {option} out, or give a light file")
        if self.crosstalk is not None and not self.lights_in_channels:
            raise UsageError(
                "--crosstalk needs --lights-in-channels", hint="Add it, or leave both out"
            )
        if self.align and self.scale is not None:
            problem = "--align needs every row and column, so it contradicts --scale"
            raise UsageError(problem, hint="Leave one out, or use --crop for a first look")
        if self.lights_in_channels and self.align:
            raise UsageError(
                "--lights-in-channels and --align contradict each other", hint="Leave one out"
            )
        if self.first_light is not None and not self.finds_lights:
            raise UsageError(
                "--first-light needs --lights estimate", hint="Add it, or leave both out"
            )
        if self.first_light is not None:
            azimuth_of(self.first_light)
        _ = self.lamps, parse_window(self.crop, self.scale)
        parse_transfer(self.transfer)
        if "exchanged" in (self.light_frame or ""):  # its name in earlier versions
            raise UsageError(f"--light-frame is {self.light_frame!r}; exchanged is now {EXCHANGED}")
        parse_light_frame(self.light_frame)

    @property
    def finds_lights(self) -> bool:
        """Whether the lights are estimated from the images."""
        return self.lights == ESTIMATE

    @property
    def light_file(self) -> str | None:
        """The light file that overrides the capture's own."""
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
        """Raise InputError if a file named in the options does not exist, or --flat-field contains
        no images.
        """
        intensities = None if self.intensities == EQUAL else self.intensities
        named = (
            self.light_file,
            self.light_positions,
            intensities,
            self.camera_matrix,
            self.mask,
            self.crosstalk,
        )
        for name in (*named, self.ground_truth, self.ambient):
            if name is not None:
                check_file(Path(name), "a file", pipe=name == self.light_file)
        self.radiometric_calibration()

    def radiometric_calibration(self) -> RadiometricCalibration:
        """Return the conversion of image values to linear light. Raises InputError."""
        flats: tuple[Path, ...] = ()
        if self.flat_field is not None:
            folder = Path(self.flat_field)
            flats = tuple(list_images(folder, leave_out_stems=("ambient", "mask"), leave_out=()))
            check_not_empty(flats, folder)
        dark = None if self.ambient is None else Path(self.ambient)
        return RadiometricCalibration(
            parse_transfer(self.transfer), dark, flats, self.transfer == AUTOMATIC
        )

    @property
    def recipe(self) -> RecipeOptions:
        """How the recipe prepares the capture."""
        return RecipeOptions(
            align=self.align,
            finds_lights=self.finds_lights,
            first_light=self.first_light,
            strict=self.strict,
        )

    def open(self, folder: Path) -> CaptureSource:
        """Open the capture in the folder with these options. Raises InputError."""
        return open_capture(
            folder,
            lights=self.light_file,
            intensities=self.intensities,
            mask=self.mask,
            ground_truth=self.ground_truth,
            radiometry=self.radiometric_calibration(),
            white_level=self.white_level,
            light_frame=parse_light_frame(self.light_frame),
            lights_format=self.light_format,
            lamps=self.lamps,
            window=parse_window(self.crop, self.scale),
            needs_lights=not self.finds_lights,
            lights_in_channels=self.lights_in_channels,
            crosstalk=self.crosstalk,
        )


class InferOptions(Reading, frozen=True, kw_only=True):
    """The options of `infer`; see its help. Raises UsageError if a value is invalid or two options
    conflict.
    """

    # The defaults follow. light_indices are zero-based. map_scales are names of maps and the values
    # shown as white, if they are not those of the rows in MAPS.
    auto_mask: Annotated[
        bool,
        Option(
            "Input",
            "",
            "If there is no mask, find the object in the images and write found_mask.png.",
        ),
    ] = False
    as_stored: AsStored = False
    refine_lights: RefineLights = False
    pixel_size: Annotated[
        Positive | None,
        Option(
            "Lights",
            "S",
            "Near lamps: the width of a pixel on the object, in the unit of the lamps."
            " With --surface: in millimetres, for"
            " a surface in millimetres.",
            default="pixel_size.txt in CAPTURE",
        ),
    ] = None
    n_lights: Annotated[
        Annotated[int, Meta(ge=MIN_LIGHTS)] | None,
        Option("Lights", "K", "Use K lights drawn at random.", default="all"),
    ] = None
    seed: RandomSeed = 0
    light_indices: Annotated[
        tuple[int, ...] | None,
        Option(
            "Lights",
            "I,J,...",
            "Use these lights, counted from 0. Plots and warnings count from 1.",
            parse=partial(parse_indices, option="--light-indices"),
        ),
    ] = None
    method: Annotated[
        str,
        Option(
            "Method",
            "METHOD",
            f"Method to use: {records.listed(method_names())}.",
            complete=method_names(),
        ),
    ] = DEFAULT_METHOD
    weights: Weights = None
    distil: Annotated[
        bool | None,
        Option(
            "Speed",
            "",
            "Approximate the network with a smaller one, trained on a sample of the capture's"
            " pixels, or use the method on"
            " every pixel.",
            default="--distil from 100,000 pixels, else --exact",
            names=("--distil/--exact",),
        ),
    ] = None
    device: DeviceName = "auto"
    precision: PrecisionName = "auto"
    output: Annotated[
        FileName, Option("Output", "OUT", "Write results to OUT/<capture name>/.", names=OUTPUT)
    ] = "out"
    formats: Annotated[
        tuple[str, ...],
        Option(
            "Output",
            "LIST",
            f"Files of the normal map: any of {records.listed(NORMALS)}. png has 16 bits, png8 has"
            " 8, npy and tiff are"
            " float32. With exr (needs the extra 'exr'), albedo and depth are written as EXR, too.",
            names=("--format",),
            items=NORMALS,
        ),
    ] = ("png", "npy")
    maps: Annotated[
        tuple[str, ...],
        Option(
            "Output",
            "LIST",
            f"Further maps to write: any of {records.listed(MAPS)}. preview is a shaded image."
            " relief:2 makes heights"
            " of 2 pixels white in the picture, and curvature:0.1 a mean curvature of 0.1 per"
            " pixel.",
            items=MAPS,
        ),
    ] = ()
    map_scales: tuple[tuple[str, Positive], ...] = ()
    html: Annotated[
        bool,
        Option("Output", "", "Also write page.html for interactive relighting, with all maps."),
    ] = False
    surface: Annotated[
        bool,
        Option(
            "Output",
            "",
            "Also write mesh.glb, mesh.ply, and depth.npy, .tiff and .png, as integrate does.",
        ),
    ] = False
    discontinuity: Annotated[NotNegative, Option("Output", "K", DISCONTINUITY_HELP)] = DISCONTINUITY
    convention: Annotated[
        Convention,
        Option("Output", "", "Green channel of the PNG files: opengl is y up, directx is y down."),
    ] = "opengl"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_lights is not None and self.light_indices is not None:
            raise UsageError(
                "--n-lights and --light-indices contradict each other", hint="Leave one out"
            )
        count = self.n_lights if self.light_indices is None else len(self.light_indices)
        if self.align and count is not None and count < MIN_IMAGES:
            option = "--n-lights" if self.light_indices is None else "--light-indices"
            problem = f"{option} leaves {count} images, but --align needs at least {MIN_IMAGES}"
            raise UsageError(problem, hint="Use more lights, or leave --align out")
        if self.mask is not None and self.auto_mask:
            raise UsageError("--mask and --auto-mask contradict each other", hint="Leave one out")
        if self.finds_lights and self.refine_lights:
            raise UsageError(
                "--lights estimate refines the lights that it finds",
                hint="Leave --refine-lights out",
            )
        check_method(self.method)
        if self.surface and self.pixel_size is not None:
            check_pixel_size(self.pixel_size)
        if self.light_indices is not None:
            check_light_indices(self.light_indices, max(self.light_indices, default=0) + 1)

    @classmethod
    def from_arguments(cls, given: dict[str, Any]) -> Self:
        """See Record. --maps also sets scales, and the seed only applies if the lights are drawn at
        random.
        """
        scales, names = [], []
        scaled = [row.name for row in MAPS.values() if row.scale is not None]
        for item in (given["maps"] or "").split(","):
            name, colon, scale = (part.strip() for part in item.partition(":"))
            names.append(name)
            if colon:
                if name not in scaled or not 0 < (to_number(scale) or 0) < math.inf:
                    expected = " or ".join(f"{name}:NUMBER" for name in scaled)
                    raise UsageError(
                        f"--maps has {item.strip()!r}; a scale is given as {expected}, above 0"
                    )
                scales.append((name, float(scale)))
        if given["maps"] is not None:
            given["maps"] = ",".join(names)
        if given["n_lights"] is None:
            given["seed"] = None
        return super().from_arguments(given).replace(map_scales=tuple(scales))

    def changes(self, earlier: InferOptions) -> list[str]:
        """Return the options that affect the results, which excludes --output and --device."""
        kinds = records.field_types(type(self))
        names = [name for name in kinds if getattr(self, name) != getattr(earlier, name)]
        options = {
            name: records.option_of(kinds[name])
            for name in names
            if name not in ("output", "device")
        }
        return list(
            dict.fromkeys(
                records.long_name(name, of) if of else "--maps" for name, of in options.items()
            )
        )

    @property
    def recipe(self) -> RecipeOptions:
        return dataclasses.replace(
            super().recipe,
            as_stored=self.as_stored,
            auto_mask=self.auto_mask,
            refine_lights=self.refine_lights,
        )

    @property
    def method_options(self) -> MethodOptions:
        """The options for the method."""
        return MethodOptions(self.weights, device=self.device, precision=self.precision)

    def check_files(self) -> None:
        """See Reading. Also raise UsageError if a package required by the options is not
        installed.
        """
        super().check_files()
        check_exr(self.formats)


def check_pixel_size(pixel_size: float) -> None:
    """Raise UsageError if a pixel size (mm) is out of range for a surface."""
    if not SMALLEST_PIXEL_MM <= pixel_size <= LARGEST_PIXEL_MM:
        raise UsageError(
            f"the pixel size is {pixel_size:g} mm, expected {SMALLEST_PIXEL_MM:g} to"
            f" {LARGEST_PIXEL_MM:g}"
        )


def parse_indices(text: str, option: str) -> tuple[int, ...]:
    """Return the integers in a text such as "0,5,12". Raises UsageError."""
    try:
        return tuple(int(item) for item in text.split(","))
    except ValueError:
        raise UsageError(
            f"{option} is {text!r}; expected zero-based numbers such as 0,5,12"
        ) from None


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
            problem = f"--shard is {number}/{count}; expected I/N with I from 1 to N"
            raise UsageError(problem, hint="If your job numbers count from 0, add 1")
        return cls(number, count)


class BatchOptions(Record, frozen=True, kw_only=True):
    """The captures of `infer`, whether existing results are computed again,
    and the printed output.
    """

    captures: Annotated[
        tuple[Path, ...],
        Option(
            "Arguments",
            "CAPTURE",
            "Folders with the images of one object each, or films.",
            repeated=True,
        ),
    ]
    shard: Annotated[
        Shard | None,
        Option(
            "Processes and machines",
            "I/N",
            "Process shard I of N: captures I, I+N, I+2N, ...",
            parse=Shard.parse,
        ),
    ] = None
    update: Update = False
    overwrite: Overwrite = False
    as_json: Annotated[
        bool,
        Option(
            "Output",
            "",
            "Print a JSON list of the reports on stdout, and nothing else.",
            names=("--json",),
        ),
    ] = False
    as_json_lines: Annotated[
        bool,
        Option(
            "Output",
            "",
            "Print each report as one line of JSON on stdout as soon as its capture is done.",
            names=("--jsonl",),
        ),
    ] = False
    quiet: Quiet = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.as_json and self.as_json_lines:
            raise UsageError("--json and --jsonl contradict each other", hint="Leave one out")
        if self.overwrite and self.update:
            raise UsageError("--overwrite and --update contradict each other", hint="Leave one out")

    @property
    def redo(self) -> Redo:
        """Which captures with existing results are computed again."""
        return "all" if self.overwrite else "changed" if self.update else "nothing"


class WatchOptions(Record, frozen=True, kw_only=True):
    """The options of `watch`; see its help."""

    folder: Annotated[
        Path,
        Option(
            "Arguments", "FOLDER", "Folder in which captures arrive, each as a subfolder or a film."
        ),
    ]
    options: Annotated[
        tuple[str, ...],
        Option("Arguments", "-- OPTIONS", "Options of infer, after two dashes.", repeated=True),
    ] = ()
    marker: Annotated[
        str | None,
        Option(
            "Captures",
            "NAME",
            "File that appears in a subfolder when it is complete.",
            default="see --settle",
        ),
    ] = None
    settle: Annotated[
        NotNegative,
        Option(
            "Captures",
            "SECONDS",
            "A film, or a subfolder without --marker, is complete when it has not changed for this"
            " long.",
        ),
    ] = 5.0


class InfoOptions(Display, frozen=True, kw_only=True):
    """The options of `info` in addition to Reading; see its help."""

    capture: Annotated[
        Path, Option("Arguments", "CAPTURE", "Folder with the images of one object, or a film.")
    ]
    auto_mask: Annotated[
        bool, Option("Input", "", "If there is no mask, find the object in the images.")
    ] = False
    check_lights: Annotated[
        bool,
        Option(
            "Lights",
            "",
            "List other readings of the light file, and how well each of them fits the images.",
        ),
    ] = False
    mended_lights: Annotated[
        Path | None,
        Option(
            "Lights",
            "FILE",
            "If the light directions fit the images better in another order or frame, write them"
            " in it.",
        ),
    ] = None
    plot: Annotated[
        Path | None, Option("Output", "FILE", "Also plot the light directions to a PNG file.")
    ] = None
    overwrite: Annotated[
        bool, Option("Output", "", "Replace an earlier plot or file of lights.")
    ] = False
