"""The options of the commands other than `infer`, `watch` and `info` as frozen records. See their
help.
"""

# Each option has a name and a type, then its panel, its help text and the kind of its value.
from __future__ import annotations

from contextlib import suppress
from itertools import chain, product
from pathlib import Path
from typing import Annotated

from msgspec import NODEFAULT, Meta

from splinecli.capture.record import ESTIMATE
from splinecli.errors import UsageError, did_you_mean
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
from splinecli.records.base import Count, FileName, NotNegative, Positive, flag, listed, option
from splinecli.records.output_files import LEVEL_NORMALS, SURFACE_FILES, SURFACE_REPORT, file_names
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.surface_files import DEFAULT_FORMATS

DEFAULT_TRIALS = 100
TRIALS_OF_MANY, MANY_METHODS = 10, 4  # fewer trials, because 900 on one capture would take hours
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

    balls: tuple[Path, ...] = option(
        "Arguments", "Folders of images of one mirror ball each.", "BALL", value=NODEFAULT
    )
    circles: tuple[tuple[float, float, float], ...] = option(
        "Input",
        "Outline of the ball in pixels, y down. May be repeated, once for each BALL.",
        "X,Y,R",
        value=(),
        names="--circle",
        parse=parse_circle,
    )
    masks: tuple[Path, ...] = option(
        "Input",
        f"{MASK_IMAGE.format('ball')} May be repeated, once for each BALL.",
        "FILE",
        value=(),
        names="--mask",
    )
    ball_diameter: Positive | None = option(
        "Input",
        "Diameter of each ball in any unit, such as millimetres. The lamps' positions have the"
        " same unit.",
        "D",
        "pixels",
    )
    camera_matrix: Path | None = option(
        "Input",
        "Text file of the 3 x 3 camera matrix in pixels.",
        "FILE",
        "focal length from EXIF, or a distant camera",
    )
    gray_ball: Path | None = option(
        "Light intensities", "Images of a matte gray ball under the same lights.", "DIR"
    )
    gray_card: Path | None = option(
        "Light intensities", "Images of a matte gray card that faces the camera.", "DIR"
    )
    lights_in_channels: bool = flag(
        "Light intensities",
        "The images of the gray ball are colour images under three coloured lamps at once:"
        " measure the crosstalk. BALL then contains one image under each lamp alone, in the order"
        " R, G, B.",
    )
    transfer: str = option(
        "Light intensities",
        "Transfer curve of the gray target's images: auto, linear, srgb or gamma:G.",
        "CURVE",
        value=AUTOMATIC,
        complete=shared.CURVES,
    )
    compare: Path | None = option(
        "Output", "Compare the result with the light directions in a text file.", "FILE"
    )
    output: Path = option(
        "Output", "Folder of the results.", "OUT", value=Path("calibration"), names=OUTPUT
    )
    overwrite: shared.Overwrite = False

    CONFLICTS = (("gray_ball", "gray_card", LEAVE_ONE),)

    def __post_init__(self) -> None:
        super().__post_init__()
        if parse_transfer(self.transfer) != 1 and not (self.gray_ball or self.gray_card):
            raise UsageError(
                "--transfer needs --gray-ball or --gray-card",
                hint="Leave --transfer out, because light directions do not depend on the curve",
            )
        if self.ball_diameter is not None and len(self.balls) < 2:
            hint = "Photograph a second ball, or the same ball at another place"
            raise UsageError("--ball-diameter needs at least two balls", hint=hint)
        if self.lights_in_channels and not self.gray_ball:
            raise UsageError(
                "--lights-in-channels needs --gray-ball",
                hint="Photograph a matte gray or white ball",
            )

        for name, values in (("--circle", self.circles), ("--mask", self.masks)):
            if values and len(values) != len(self.balls):
                times = "once" if len(values) == 1 else f"{len(values)} times"
                raise UsageError(
                    f"{name} is given {times} for {len(self.balls)} balls",
                    hint="Give it once for each ball, in the same order",
                )


def parse_level(text: str) -> tuple[tuple[int, int], ...]:
    """Return the points in a text such as "10,20 90,20 50,80", or an empty tuple for "plane".

    Raises UsageError.
    """
    if text.strip() == "plane":
        return ()
    with suppress(ValueError):
        points = tuple((int(x), int(y)) for x, y in (point.split(",") for point in text.split()))
        if len(points) >= 3:
            return points
    raise UsageError(
        f'--level is {text!r}; expected plane, or at least three points "X,Y X,Y X,Y"',
        hint=did_you_mean(text, ("plane",)) or "Put quotation marks around the points",
    )


class IntegrateOptions(Display, frozen=True, kw_only=True):
    """The options of `integrate`."""

    normals: Path = option(
        "Arguments",
        "Normal map (.npy, .png, .tif, .mat), or a folder that infer wrote.",
        "NORMALS",
        value=NODEFAULT,
    )
    mask: Path | None = option(
        "Input", MASK_IMAGE.format("object"), "FILE", "all pixels that have a normal"
    )
    camera_matrix: Path | None = option(
        "Input",
        "Text file of the 3 x 3 camera matrix in pixels, for a perspective camera.",
        "FILE",
        "as in report.json beside the normal map, or orthographic",
    )
    pixel_size: (
        Annotated[float, Meta(ge=shared.SMALLEST_PIXEL_MM, le=shared.LARGEST_PIXEL_MM)] | None
    ) = option(
        "Input",
        "Width of a pixel of the photographs on the object in millimetres, for a surface in"
        " millimetres.",
        "MM",
        "from report.json of infer --surface beside the normal map, or none",
    )
    pixel_aspect: Annotated[float, Meta(ge=0.01, le=100)] = option(
        "Input",
        "Height of a pixel on the object relative to its width, for line scanners and scaled"
        " images.",
        "A",
        value=1.0,
    )
    convention: Convention | None = option(
        "Input",
        "Green channel of a normal map stored as colours: opengl is y up, directx is y down.",
        "NAME",
        "as in report.json beside it, or opengl",
    )
    colours: Path | None = option(
        "Input",
        "Image of the object's colours, for the mesh.",
        "FILE",
        "albedo.png beside NORMALS, if NORMALS is a folder",
    )
    prior: Path | None = option(
        "Input",
        "Depth map of the same view from another source, such as a scan, for the overall shape of"
        " the surface; the detail comes from the normals. .npy, .tif or .exr, with heights"
        " towards the camera in the unit of the result, or with depths in millimetres for a"
        " perspective camera. NaN is unknown.",
        "FILE",
    )
    discontinuity: NotNegative | None = option(
        "Method",
        shared.DISCONTINUITY_HELP,
        "K",
        f"as in report.json beside the normal map, or {DISCONTINUITY:g}",
    )
    prior_detail: Annotated[float, Meta(ge=1)] | None = option(
        "Method",
        "With --prior: shapes narrower than this come from the normals.",
        "PIXELS",
        "15 % of the object's size",
    )
    largest_step: NotNegative | None = option(
        "Method",
        "Leave out triangles whose corners differ by more than this height.",
        "PIXELS",
        "keep all",
    )
    level: tuple[tuple[int, int], ...] | None = option(
        "Method",
        'Level the surface, and write its normals: three or more pixels "X,Y X,Y X,Y" define the'
        " plane that becomes level, or the word plane chooses the dominant one.",
        "POINTS",
        parse=parse_level,
    )
    output: Path | None = option(
        "Output", "Folder of the results.", "OUT", "the folder of NORMALS", names=OUTPUT
    )
    formats: tuple[str, ...] = option(
        "Output",
        f"Files to write, any of {', '.join(SURFACE_FILES)}: meshes, and depth maps in float32 or"
        " as a 16-bit picture (png). exr needs the extra 'exr'.",
        "LIST",
        value=DEFAULT_FORMATS,
        names="--format",
        items=SURFACE_FILES,
    )
    decimate: Count | None = option(
        "Output",
        "Reduce the mesh to N triangles; a texture of the normals keeps the detail in GLB (needs"
        " the extra 'mesh').",
        "N",
        "all",
    )
    solid: Annotated[float, Meta(gt=0, le=1e4)] | None = option(
        "Output",
        "Close the mesh for printing, with walls along its border and a flat back at this distance"
        " behind its lowest point.",
        "MM",
        "open",
    )
    overwrite: shared.Overwrite = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.prior_detail is not None and self.prior is None:
            hint = "Add --prior, or leave --prior-detail out"
            raise UsageError("--prior-detail needs --prior", hint=hint)
        of_mesh = {"--solid": self.solid, "--decimate": self.decimate}
        given = [name for name, value in of_mesh.items() if value is not None]
        if given and not any("mesh" in name for name in self.files):
            raise UsageError(
                f"{given[0]} changes the mesh, but --format names no mesh",
                hint="Add glb, ply, obj, stl or 3mf",
            )
        if self.decimate is not None and self.pixel_aspect != 1:
            raise UsageError(
                "--decimate needs square pixels, so it cannot be used with --pixel-aspect",
                hint=LEAVE_ONE,
            )

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

    The method "all" stands for all methods. Among the numbers of lights, None stands for all
    lights. If no number is given, DEFAULT_LIGHTS or the number in the draws file is used.
    """

    datasets: tuple[Path, ...] = option(
        "Arguments",
        "Folders of captures with ground truth, or the captures themselves.",
        "DATASET",
        value=NODEFAULT,
    )
    skip_first: tuple[tuple[str, int], ...] = option(
        "Input",
        "Leave out the first N images of one capture, or of all. May be repeated.",
        "[CAPTURE=]N",
        "0",
        value=(),
        parse=parse_skip,
    )
    max_pixels: Count | None = option("Input", "Score N random pixels of each capture.", "N", "all")
    as_stored: shared.AsStored = False
    white_level: shared.GivenWhiteLevel = None
    lights: str | None = option(
        "Lights",
        "Estimate the lights of each draw from its images, and score them, too.",
        "estimate",
        "the captures' light files",
    )
    n_lights: tuple[int | None, ...] = option(
        "Lights",
        "Number of lights in each draw, or all. May be repeated.",
        "K",
        str(DEFAULT_LIGHTS),
        value=(),
        parse=parse_light_count,
    )
    trials: Count | None = option(
        "Lights",
        "Number of random draws.",
        "T",
        f"{DEFAULT_TRIALS}; {TRIALS_OF_MANY} with four methods or more",
    )
    seed: shared.RandomSeed = 0
    draws: FileName | None = option(
        "Lights", "Draws of lights: each line has light indices, counted from 0.", "FILE"
    )
    light_noise_deg: tuple[NotNegative, ...] = option(
        "Lights",
        "Tilt the lights at random, with this standard deviation in degrees. May be repeated.",
        "SIGMA",
        value=(0.0,),
    )
    refine_lights: shared.RefineLights = False
    light_error_deg: float | None = option(
        "Lights", "With --refine-lights: usual error of the directions in degrees.", "SIGMA", "5"
    )
    methods: tuple[str, ...] = option(
        "Method",
        f"Method to score: all, {listed(method_names())}. May be repeated.",
        "M",
        value=(DEFAULT_METHOD,),
        names="--method",
        complete=(*method_names(), "all"),
    )
    weights: shared.Weights = None
    rotations: Count | None = option(
        "Method",
        "Average the network's results over R rotations of the lights of each pixel, for spline-net"
        " also mirrored.",
        "R",
        "1; cnn-ps: 10",
    )
    device: shared.DeviceName = "auto"
    precision: shared.PrecisionName = "auto"
    jobs: Count | None = option(
        "Speed", "Number of trials at a time.", "N", "number of cores; 1 on a GPU"
    )
    cluster: ClusterOptions = HERE
    figures: bool = flag("Output", "Draw every method's maps for the first draw of each capture.")
    pixels: tuple[tuple[int, int], ...] = option(
        "Output",
        "With --figures: show the observation maps of this pixel. May be repeated.",
        "ROW,COLUMN",
        value=(),
        names="--pixel",
        parse=parse_pixel,
    )
    relight: bool = flag(
        "Output",
        "Estimate normals and material from the first draw of each capture, render the capture"
        " under its other lights, and compare with the photographs.",
    )
    output: FileName = option(
        "Output", "Folder of the results.", "OUT", value="evaluation", names=OUTPUT
    )
    overwrite: bool = flag("Output", "Compute all trials again, including those stored in OUT.")

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
                hint="Without --lights, the light files of the captures are used",
            )
        if self.lights is not None and (self.refine_lights or any(self.light_noise_deg)):
            raise UsageError(
                "--lights estimate does not use a light file, so it cannot be used with"
                " --refine-lights or --light-noise-deg",
                hint="Leave these options out",
            )
        if self.cluster != HERE and self.jobs is not None:
            raise UsageError(
                "--jobs cannot be used with --workers or --cluster",
                hint="Leave --jobs out, because a worker scores one trial at a time",
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
        """One protocol for each combination of the number of lights and the light noise.

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
