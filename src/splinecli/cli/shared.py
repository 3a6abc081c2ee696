"""Options that several commands have, and the values of options: their completion, their parsing, and their records.

A command declares its other options in its signature.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from enum import Enum, StrEnum
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from typer import Option

from splinecli.capture.light_files import light_suffixes
from splinecli.errors import UsageError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from splinecli.calibration.circle import Circle
    from splinecli.pipeline.distribution import ClusterOptions

    Record = TypeVar("Record", bound=DataclassInstance)

_MOST_DIGITS = 18  # of a number of images


# Each is a type of Typer: the values that an option may have.
Device = StrEnum("Device", ["auto", "cpu", "cuda"])
LightForm = StrEnum("LightForm", {"xyz": "xyz", "azel": "azel", "slant_tilt": "slant-tilt"})
NormalConvention = StrEnum("NormalConvention", ["opengl", "directx"])
Precision = StrEnum("Precision", ["auto", "float32", "bfloat16"])


def complete_sides() -> list[str]:
    """Return the sides that a first light may come from."""
    from splinecli.capture.record import SIDES_DEG

    return [*SIDES_DEG]


def complete_curves() -> list[str]:
    """Return transfer curves, the last of them as an example."""
    return ["auto", "linear", "srgb", "gamma:2.2"]


def complete_weights() -> list[str]:
    """Return the names of the shipped weights. If none begins with the typed text, the shell completes file names."""
    # The module that reads this file imports torch, which takes too long for a completion.
    return list(json.loads((resources.files("splinecli") / "assets/weights.json").read_text("utf-8")))


def listed(names: Iterable[str]) -> str:
    """Return "a, b or c"."""
    *most, last = names
    return f"{', '.join(most)} or {last}" if most else last


def complete_list(items: Iterable[str]) -> Callable[[str], list[str]]:
    """Return the completion of a list "a,b": the typed items, and each further one behind the last comma."""

    def complete(incomplete: str) -> list[str]:
        *typed, _ = incomplete.split(",")
        return [",".join([*typed, name]) for name in items if name not in typed]

    return complete


def split_commas(text: str, option: str, allowed: Iterable[str]) -> tuple[str, ...]:
    """Return the items of "a,b". Raises UsageError for an item that is not allowed."""
    names = list(allowed)
    items = tuple(item.strip() for item in text.split(",") if item.strip())
    for item in items:
        if item not in names:
            raise UsageError(f"{option} has {item!r}; expected a list of {', '.join(names)}, such as {names[0]}")
    if not items:
        raise UsageError(f"{option} is empty; expected a list of {', '.join(names)}")
    return items


def parse_cluster(workers: str, address: str | None = None, *, gpu: bool = False) -> ClusterOptions | None:
    """Return where --workers and --cluster let tasks be done; None for this process. Raises UsageError."""
    from splinecli.pipeline.distribution import ClusterOptions

    if workers != "auto" and (not workers.isdecimal() or len(workers) > 4 or int(workers) < 1):
        raise UsageError(f"--workers is {workers!r}; expected a number from 1, or auto")
    if address is not None and workers != "1":
        raise UsageError(
            "--workers and --cluster contradict each other", hint="Leave --workers out: the cluster has its workers"
        )
    if address is None and workers == "1":
        return None
    number = 0 if workers == "auto" else int(workers)
    return ClusterOptions(workers=number, address=address, gpu=gpu)


def parse_indices(text: str, option: str) -> tuple[int, ...]:
    """Return the whole numbers of "0,5,12". Raises UsageError."""
    try:
        return tuple(int(item) for item in text.split(","))
    except ValueError:
        raise UsageError(f"{option} is {text!r}; expected zero-based numbers such as 0,5,12") from None


def parse_circle(text: str) -> Circle:
    """Return the circle of "X,Y,R". Raises UsageError."""
    from splinecli.calibration.circle import Circle

    try:
        x, y, radius = (float(word) for word in text.split(","))
        if radius > 0 and abs(x) + abs(y) + radius < float("inf"):
            return Circle(x, y, radius)
    except ValueError:
        pass
    raise UsageError(f"--circle is {text!r}; expected X,Y,R in pixels, such as 512,384,200")


def parse_skip(text: str) -> tuple[str, int]:
    """Return ("bearPNG", 20) for "bearPNG=20" and ("*", 20) for "20". Raises UsageError."""
    from splinecli.evaluation.protocol import EVERY_CAPTURE

    name, equals, count = text.rpartition("=")
    if not count.isdecimal() or len(count) > _MOST_DIGITS or bool(name) != bool(equals):
        raise UsageError(f"--skip-first is {text!r}; expected a number, or one for a capture as in bearPNG=20")
    return name or EVERY_CAPTURE, int(count)


def parse_pixel(text: str) -> tuple[int, int]:
    """Return the row and the column of "120,85". Raises UsageError."""
    indices = parse_indices(text, "--pixel")
    if len(indices) != 2 or min(indices) < 0:
        raise UsageError(f"--pixel is {text!r}; expected a row and a column such as 120,85")
    return indices[0], indices[1]


def parse_light_count(text: str) -> int | None:
    """Return a number of lights, or None for "all". Raises UsageError."""
    if text == "all":
        return None
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--n-lights is {text!r}; expected a number of lights, or all") from None


def record_from(record: type[Record], arguments: Mapping[str, Any], **values: Any) -> Record:
    """Build a frozen dataclass of options from the arguments of a command that have the names of its fields.

    A choice becomes its value, a list a tuple, and a path text if the field holds no path. `values` are those of fields
    that need more than this. Raises UsageError if the record refuses a value.
    """
    given = {
        field.name: _of_field(arguments[field.name], str(field.type))
        for field in fields(record)
        if field.name in arguments
    }
    return record(**given | values)


def _of_field(value: Any, kind: str) -> Any:
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, list):
        return tuple(value)
    return str(value) if isinstance(value, Path) and "Path" not in kind else value


MASK_IMAGE = "Mask image, white on the {} (above half of its largest value)."
STIFFNESS = "How easily the surface of integrate or --surface tears at edges: more with a larger number, never with 0."
CLUSTER = (
    "{} on the workers of a running Dask cluster: the address of its scheduler, or its scheduler file (needs the extra"
    " 'cluster')."
)
PIXEL_SIZE = "Near lamps: the width of a pixel on the object. [default: pixel_size.txt in CAPTURE]"

# Input and lights.

LIGHTS = Option(
    None,
    metavar="FILE|estimate",
    help=f"Light directions ({light_suffixes()}): x y z for each image, z to the camera. estimate finds them from the"
    " images, less exactly. [default: the light file in CAPTURE]",
)
FIRST_LIGHT = Option(
    None,
    metavar="SIDE|DEGREES",
    help="With --lights estimate: where the light of the first image that is used comes from, as left, above,"
    " upper-left or its azimuth, counter-clockwise from the right. Objects without outline need it.",
    autocompletion=complete_sides,
)
LIGHT_FRAME = Option(
    None,
    metavar="LIST",
    help="Frame of the light file: any of x-left, y-down, z-away and exchanged (y stands before x)."
    " [default: x right, y up, z to the camera]",
    autocompletion=complete_list(["x-left", "y-down", "z-away", "exchanged"]),
)
LIGHTS_FORMAT = Option(
    LightForm.xyz,
    help="Numbers of a light in a text file: a vector x y z; azel, azimuth and elevation; or slant-tilt, the angles"
    " of HALCON. Angles are in degrees.",
)
INTENSITIES = Option(
    None,
    metavar="FILE|equal",
    help="Light intensities: a line r g b for each image. [default: equal, or estimated if the images show that"
    " they differ]",
)
REFINE_LIGHTS = Option(
    False, "--refine-lights", help="Refine rough light directions so that they fit the images better."
)
LIGHT_POSITIONS = Option(
    None,
    metavar="FILE",
    help="Near lamps: a line x y z for each image, in any unit, from the middle of the image."
    " [default: light_positions.txt in CAPTURE]",
)
LIGHT_DISTANCE = Option(None, metavar="D", help="Near lamps: the distance of all lamps from the middle of the object.")
OBJECT_WIDTH = Option(
    None, metavar="W", help="Near lamps: the width of the object in its mask, in place of --pixel-size."
)
CAMERA_MATRIX = Option(
    None,
    metavar="FILE",
    help="Text file of the 3 x 3 camera matrix in pixels, for a perspective camera: each pixel is then estimated in the"
    " frame of its viewing ray. [default: camera_matrix.txt in CAPTURE, or orthographic]",
)
MASK = Option(None, metavar="FILE", help=f"{MASK_IMAGE.format('object')} [default: a file named mask.*, or all pixels]")
CROP = Option(None, metavar="X,Y,W,H", help="Read this box of the images: left upper corner and size in pixels.")
SCALE = Option(None, metavar="1/N", help="Read every N-th row and column, for a first look. [default: all]")
GROUND_TRUTH = Option(None, metavar="FILE", help="True normals to compare with (.mat, .npy, text, PNG, TIFF).")
TRANSFER = Option(
    "auto",
    metavar="CURVE",
    help="Transfer curve of the images: auto, linear, srgb or gamma:G. auto reads files as they say; JPEG as sRGB.",
    autocompletion=complete_curves,
)
AMBIENT = Option(
    None, metavar="FILE", help="Image taken without the lights, to subtract from all images. [default: ambient.*]"
)
FLAT_FIELD = Option(
    None,
    metavar="DIR",
    help="Folder with images of an evenly white surface: one for all lights, or one for each light.",
)
WHITE_LEVEL = Option(
    None, metavar="N", min=0, help="Stored value from which a pixel counts as saturated. [default: found in the images]"
)
AS_STORED = Option(
    False,
    "--as-stored",
    help="Use the stored values: do not remove lens blur, restore saturated pixels or estimate light intensities.",
)
SEED = Option(0, metavar="S", min=0, max=2**32 - 1, help="Seed of the random draws.")

# Method and speed.

WEIGHTS = Option(
    None,
    metavar="NAME|FILE",
    help="Weights: a shipped name or a file. [default: those of the method]",
    autocompletion=complete_weights,
)
DEVICE = Option(Device.auto, help="Device to compute on. auto is a CUDA GPU if there is one, else the CPU.")
PRECISION = Option(Precision.auto, help="Number format. auto is bfloat16 if the hardware supports it, else float32.")

# Output.

OVERWRITE = Option(False, "--overwrite", help="Replace earlier results.")
UPDATE = Option(False, "--update", help="Compute changed captures again, and skip those that are done.")
STRICT = Option(
    False, "--strict", help="Fail (exit code 3) where a warning says that the lights or the images are probably wrong."
)
JSON = Option(False, "--json", help="Print one JSON document on stdout, and nothing else.")
QUIET = Option(False, "--quiet", "-q", help="Print nothing but errors.")
