"""The options of the commands that are not for individual captures, as frozen records. See their
help.
"""

# The options form a table: name, type, panel and kind of value, then the help text.
from __future__ import annotations

from contextlib import suppress
from itertools import chain, product
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from splinecli.capture.record import ESTIMATE
from splinecli.errors import UsageError
from splinecli.estimate.methods import (
    DEFAULT_METHOD,
    METHODS,
    MethodOptions,
    check_method,
    method_names,
)
from splinecli.evaluation.protocol import EVERY_CAPTURE, Protocol
from splinecli.maths.normals import Convention
from splinecli.maths.transfer import AUTOMATIC, parse_transfer
from splinecli.pipeline import infer_options as shared
from splinecli.pipeline.infer_options import (
    HERE,
    LEAVE_ONE,
    MASK_IMAGE,
    OUTPUT,
    ClusterOptions,
    Display,
    parse_indices,
)
from splinecli.records.base import Count, FileName, NotNegative, Option, Positive, listed
from splinecli.records.output_files import LEVEL_NORMALS, SURFACE_FILES, SURFACE_REPORT, file_names
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.surface_files import DEFAULT_FORMATS

DEFAULT_TRIALS = 100
TRIALS_OF_MANY, MANY_METHODS = 10, 4  # 900 trials of all methods on one capture took hours
DEFAULT_LIGHTS = 10


def parse_circle(text: str) -> tuple[float, float, float]:
    """Return the numbers in a text "X,Y,R". Raises UsageError."""
    with suppress(ValueError):
        x, y, radius = (float(word) for word in text.split(","))
        if radius > 0 and abs(x) + abs(y) + radius < float("inf"):
            return x, y, radius
    raise UsageError(f"--circle is {text!r}; expected X,Y,R in pixels, such as 512,384,200")


class CalibrateOptions(Display, frozen=True, kw_only=True):
    """The options of `calibrate`."""

    balls: Annotated[
        tuple[Path, ...], Option("Arguments", "Folders of images of one mirror ball each.", "BALL")
    ]
    circles: Annotated[
        tuple[tuple[float, float, float], ...],
        Option(
            "Input",
            "Outline of the ball in pixels, y down. May be repeated, once for each BALL.",
            "X,Y,R",
            names="--circle",
            parse=parse_circle,
        ),
    ] = ()
    masks: Annotated[
        tuple[Path, ...],
        Option(
            "Input",
            f"{MASK_IMAGE.format('ball')} May be repeated, once for each BALL.",
            "FILE",
            names="--mask",
        ),
    ] = ()
    ball_diameter: Annotated[
        Positive | None,
        Option(
            "Input",
            "Diameter of each ball in any unit, such as millimetres. The lamps' positions have the"
            " same unit.",
            "D",
            "pixels",
        ),
    ] = None
    camera_matrix: Annotated[
        Path | None,
        Option(
            "Input",
            "Text file of the 3 x 3 camera matrix in pixels.",
            "FILE",
            "focal length from EXIF, or a distant camera",
        ),
    ] = None
    gray_ball: Annotated[
        Path | None,
        Option("Light intensities", "Images of a matte gray ball under the same lights.", "DIR"),
    ] = None
    gray_card: Annotated[
        Path | None,
        Option("Light intensities", "Images of a matte gray card that faces the camera.", "DIR"),
    ] = None
    lights_in_channels: Annotated[
        bool,
        Option(
            "Light intensities",
            "The images of the gray ball are colour images under three coloured lamps at once:"
            " measure the crosstalk. BALL then contains one image under each lamp alone, in the"
            " order R, G, B.",
        ),
    ] = False
    transfer: Annotated[
        str,
        Option(
            "Light intensities",
            "Transfer curve of the gray target's images: auto, linear, srgb or gamma:G.",
            "CURVE",
            complete=shared.CURVES,
        ),
    ] = AUTOMATIC
    compare: Annotated[
        Path | None,
        Option("Output", "Compare the result with the light directions in a text file.", "FILE"),
    ] = None
    output: Annotated[Path, Option("Output", "Folder of the results.", "OUT", names=OUTPUT)] = Path(
        "calibration"
    )
    overwrite: shared.Overwrite = False

    CONFLICTS = (("gray_ball", "gray_card", LEAVE_ONE),)

    def __post_init__(self) -> None:
        super().__post_init__()
        if parse_transfer(self.transfer) != 1 and not (self.gray_ball or self.gray_card):
            raise UsageError(
                "--transfer needs --gray-ball or --gray-card",
                hint="Leave it out: the light directions do not depend on the curve",
            )
        if self.ball_diameter is not None and len(self.balls) < 2:
            hint = "Photograph a second ball, or the same ball at another place: one ball gives no"
            raise UsageError("--ball-diameter needs two balls or more", hint=f"{hint} positions")
        if self.lights_in_channels and not self.gray_ball:
            raise UsageError(
                "--lights-in-channels needs --gray-ball",
                hint="Photograph a matte gray or white ball",
            )

        for option, values in (("--circle", self.circles), ("--mask", self.masks)):
            if values and len(values) != len(self.balls):
                times = "once" if len(values) == 1 else f"{len(values)} times"
                raise UsageError(
                    f"{option} is given {times} for {len(self.balls)} balls",
                    hint="Give it once for each ball, in the same order",
                )


def parse_level(text: str) -> tuple[tuple[int, int], ...]:
    """Return the points in a text such as "10,20 90,20 50,80", or () for "plane". Raises
    UsageError.
    """
    if text.strip() == "plane":
        return ()
    with suppress(ValueError):
        points = tuple((int(x), int(y)) for x, y in (point.split(",") for point in text.split()))
        if len(points) >= 3:
            return points
    raise UsageError(
        f'--level is {text!r}; expected plane, or at least three points "X,Y X,Y X,Y"',
        hint="Put quotation marks around the points",
    )


class IntegrateOptions(Display, frozen=True, kw_only=True):
    """The options of `integrate`."""

    normals: Annotated[
        Path,
        Option(
            "Arguments",
            "Normal map (.npy, .png, .tif, .mat), or a folder that infer wrote.",
            "NORMALS",
        ),
    ]
    mask: Annotated[
        Path | None,
        Option("Input", MASK_IMAGE.format("object"), "FILE", "all pixels that have a normal"),
    ] = None
    camera_matrix: Annotated[
        Path | None,
        Option(
            "Input",
            "Text file of the 3 x 3 camera matrix in pixels, for a perspective camera.",
            "FILE",
            "as in report.json beside the normal map, or orthographic",
        ),
    ] = None
    pixel_size: Annotated[
        Annotated[float, Meta(ge=shared.SMALLEST_PIXEL_MM, le=shared.LARGEST_PIXEL_MM)] | None,
        Option(
            "Input",
            "Width of a pixel of the photographs on the object in millimetres, for a surface in"
            " millimetres.",
            "MM",
            "as given to infer --surface by report.json beside the normal map, or none",
        ),
    ] = None
    pixel_aspect: Annotated[
        Annotated[float, Meta(ge=0.01, le=100)],
        Option(
            "Input",
            "Height of a pixel on the object, in widths of a pixel, for line scanners and scaled"
            " images.",
            "A",
        ),
    ] = 1.0
    convention: Annotated[
        Convention | None,
        Option(
            "Input",
            "Green channel of a normal map of colours: opengl is y up, directx is y down.",
            default="as in report.json beside it, or opengl",
        ),
    ] = None
    colours: Annotated[
        Path | None,
        Option(
            "Input",
            "Image of the object's colours, for the mesh.",
            "FILE",
            "albedo.png beside NORMALS, if NORMALS is a folder",
        ),
    ] = None
    prior: Annotated[
        Path | None,
        Option(
            "Input",
            "Depth map of the same view from elsewhere, such as a scan: the surface takes its"
            " overall shape from it, and the detail from the normals. .npy, .tif or .exr, with"
            " heights towards the camera in the unit of the result, or with depths in millimetres"
            " for a perspective camera. NaN is unknown.",
            "FILE",
        ),
    ] = None
    discontinuity: Annotated[
        NotNegative | None,
        Option(
            "Method",
            shared.DISCONTINUITY_HELP,
            "K",
            f"as in report.json beside the normal map, or {DISCONTINUITY:g}",
        ),
    ] = None
    prior_detail: Annotated[
        Annotated[float, Meta(ge=1)] | None,
        Option(
            "Method",
            "With --prior: shapes narrower than this come from the normals.",
            "PIXELS",
            "15 % of the object's size",
        ),
    ] = None
    largest_step: Annotated[
        NotNegative | None,
        Option(
            "Method",
            "Leave out triangles whose corners differ by more than this height.",
            "PIXELS",
            "keep all",
        ),
    ] = None
    level: Annotated[
        tuple[tuple[int, int], ...] | None,
        Option(
            "Method",
            "Level the surface, and write its normals: plane removes the slope of"
            " its dominant plane; three or"
            ' more pixels "X,Y X,Y X,Y" define the plane that becomes level.',
            "plane|POINTS",
            parse=parse_level,
        ),
    ] = None
    output: Annotated[
        Path | None,
        Option("Output", "Folder of the results.", "OUT", "the folder of NORMALS", names=OUTPUT),
    ] = None
    formats: Annotated[
        tuple[str, ...],
        Option(
            "Output",
            f"Files to write, any of {', '.join(SURFACE_FILES)}: meshes, and depth maps in float32"
            " or as a 16-bit picture (png). exr needs the extra 'exr'.",
            "LIST",
            names="--format",
            items=SURFACE_FILES,
        ),
    ] = DEFAULT_FORMATS
    decimate: Annotated[
        Count | None,
        Option(
            "Output",
            "Reduce the mesh to N triangles; a texture of the normals keeps the detail in GLB"
            " (needs the extra 'mesh').",
            "N",
            "all",
        ),
    ] = None
    overwrite: shared.Overwrite = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.prior_detail is not None and self.prior is None:
            raise UsageError("--prior-detail needs --prior")
        if self.decimate is not None and self.pixel_aspect != 1:
            raise UsageError("--decimate needs square pixels, so it contradicts --pixel-aspect")

    @property
    def folder(self) -> Path:
        """The folder of the results."""
        return self.output or (self.normals if self.normals.is_dir() else self.normals.parent)

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the files that may be written."""
        levelled = () if self.level is None else LEVEL_NORMALS
        return (*file_names(self.formats), *levelled, SURFACE_REPORT)


def parse_light_count(text: str) -> int | None:
    """Return a number of lights, or None for "all". Raises UsageError."""
    try:
        return None if text == "all" else int(text)
    except ValueError:
        raise UsageError(f"--n-lights is {text!r}; expected a number of lights, or all") from None


def parse_skip(text: str) -> tuple[str, int]:
    """Return ("bearPNG", 20) for "bearPNG=20" and ("*", 20) for "20". Raises UsageError."""
    name, equals, count = text.rpartition("=")
    if not count.isdecimal() or len(count) > 18 or bool(name) != bool(equals):
        raise UsageError(
            f"--skip-first is {text!r}; expected a number, or one for a capture as in bearPNG=20"
        )
    return name or EVERY_CAPTURE, int(count)


def parse_pixel(text: str) -> tuple[int, int]:
    """Return the row and the column for a text such as "120,85". Raises UsageError."""
    indices = parse_indices(text, "--pixel")
    if len(indices) != 2 or min(indices) < 0:
        raise UsageError(f"--pixel is {text!r}; expected a row and a column such as 120,85")
    return indices[0], indices[1]


class EvaluateOptions(Display, frozen=True, kw_only=True):
    """The options of `evaluate`.

    The method "all" stands for all methods. None among the numbers of lights stands for all lights.
    Without any number, DEFAULT_LIGHTS is used, or the number in the draws file.
    """

    datasets: Annotated[
        tuple[Path, ...],
        Option(
            "Arguments",
            "Folders of captures with ground truth, or the captures themselves.",
            "DATASET",
        ),
    ]
    skip_first: Annotated[
        tuple[tuple[str, int], ...],
        Option(
            "Input",
            "Leave out the first N images of one capture, or of all. May be repeated.",
            "[CAPTURE=]N",
            "0",
            parse=parse_skip,
        ),
    ] = ()
    max_pixels: Annotated[
        Count | None, Option("Input", "Score N random pixels of each capture.", "N", "all")
    ] = None
    as_stored: shared.AsStored = False
    white_level: shared.WhiteLevel = None
    lights: Annotated[
        str | None,
        Option(
            "Lights",
            "Estimate the lights of each draw from its images, and score them, too.",
            "estimate",
            "the captures' light files",
        ),
    ] = None
    n_lights: Annotated[
        tuple[int | None, ...],
        Option(
            "Lights",
            "Number of lights in each draw. May be repeated.",
            "K|all",
            str(DEFAULT_LIGHTS),
            parse=parse_light_count,
        ),
    ] = ()
    trials: Annotated[
        Count | None,
        Option(
            "Lights",
            "Number of random draws.",
            "T",
            f"{DEFAULT_TRIALS}; {TRIALS_OF_MANY} with four methods or more",
        ),
    ] = None
    seed: shared.RandomSeed = 0
    draws: Annotated[
        FileName | None,
        Option("Lights", "Draws of lights: each line has light indices, counted from 0.", "FILE"),
    ] = None
    light_noise_deg: Annotated[
        tuple[NotNegative, ...],
        Option(
            "Lights",
            "Tilt the lights at random, with this standard deviation in degrees. May be repeated.",
            "SIGMA",
        ),
    ] = (0.0,)
    refine_lights: shared.RefineLights = False
    light_error_deg: Annotated[
        float | None,
        Option(
            "Lights",
            "With --refine-lights: usual error of the directions in degrees.",
            "SIGMA",
            "5",
        ),
    ] = None
    methods: Annotated[
        tuple[str, ...],
        Option(
            "Method",
            f"Method to score: all, {listed(method_names())}. May be repeated.",
            "M",
            names="--method",
            complete=(*method_names(), "all"),
        ),
    ] = (DEFAULT_METHOD,)
    weights: shared.Weights = None
    rotations: Annotated[
        Count | None,
        Option(
            "Method",
            "Average the network's result over R views of each pixel: its lights rotated, for"
            " spline-net also mirrored.",
            "R",
            "1; cnn-ps: 10",
        ),
    ] = None
    device: shared.DeviceName = "auto"
    precision: shared.PrecisionName = "auto"
    jobs: Annotated[
        Count | None,
        Option("Speed", "Number of trials at a time.", "N", "number of cores; 1 on a GPU"),
    ] = None
    cluster: ClusterOptions = HERE
    figures: Annotated[
        bool, Option("Output", "Draw every method's maps for the first draw of each capture.")
    ] = False
    pixels: Annotated[
        tuple[tuple[int, int], ...],
        Option(
            "Output",
            "With --figures: show the observation maps of this pixel. May be repeated.",
            "ROW,COLUMN",
            names="--pixel",
            parse=parse_pixel,
        ),
    ] = ()
    relight: Annotated[
        bool,
        Option(
            "Output",
            "Estimate normals and material from the first draw of each capture, render the capture"
            " under its other lights, and compare with the photographs.",
        ),
    ] = False
    output: Annotated[FileName, Option("Output", "Folder of the results.", "OUT", names=OUTPUT)] = (
        "evaluation"
    )
    overwrite: Annotated[
        bool, Option("Output", "Compute all trials again, also those stored in OUT.")
    ] = False

    CONFLICTS = (
        ("draws", "n_lights", "Leave --n-lights out: the draws determine the number of lights"),
        ("draws", "trials", "Leave --trials out: each line of the draws is a trial"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        from splinecli.lights.light_fit import check_light_error

        check_light_error(self.light_error_deg, refines=self.refine_lights)
        if self.lights not in (None, ESTIMATE):
            raise UsageError(
                f"--lights is {self.lights}; expected {ESTIMATE}",
                hint="Without it, the light files of the captures are used",
            )
        if self.lights is not None and (self.refine_lights or any(self.light_noise_deg)):
            problem = "--lights estimate uses no light file, so it contradicts --refine-lights and"
            raise UsageError(f"{problem} --light-noise-deg", hint="Leave these out")
        if self.cluster != HERE and self.jobs is not None:
            raise UsageError(
                "--jobs contradicts --workers and --cluster",
                hint="Leave it out: a worker scores one trial at a time",
            )
        for name in self.names:
            check_method(name)
        with_maps = self.figures and any(METHODS[name].observation_maps for name in self.names)
        if self.pixels and not with_maps:
            raise UsageError(
                "--pixel chooses the observation maps that --figures shows",
                hint="Add --figures and --method spline-net",
            )
        _ = self.protocols

    @property
    def names(self) -> list[str]:
        """The names of the methods, without duplicates."""
        chosen = (method_names() if name == "all" else [name] for name in self.methods)
        return list(dict.fromkeys(chain.from_iterable(chosen)))

    @property
    def method_options(self) -> MethodOptions:
        """The options for the methods."""
        device, precision = self.device, self.precision
        return MethodOptions(self.weights, self.rotations, device=device, precision=precision)

    @property
    def protocols(self) -> list[Protocol]:
        """One protocol for each combination of number of lights and light noise.
        Raises UsageError.
        """
        from splinecli.lights.light_fit import LIGHT_ERROR_DEG

        usual = TRIALS_OF_MANY if len(self.names) >= MANY_METHODS else DEFAULT_TRIALS
        counts = self.n_lights or ((DEFAULT_LIGHTS,) if self.draws is None else (None,))
        return [
            Protocol(
                count,
                usual if self.trials is None else self.trials,
                self.seed,
                None if self.draws is None else Path(self.draws),
                noise,
                self.max_pixels,
                dict(self.skip_first),
                self.as_stored,
                self.white_level,
                (self.light_error_deg or LIGHT_ERROR_DEG) if self.refine_lights else None,
                self.lights is not None,
            )
            for count, noise in product(dict.fromkeys(counts), dict.fromkeys(self.light_noise_deg))
        ]
