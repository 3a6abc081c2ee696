"""The files and options that say where near lamps are, and how large a pixel is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from splinecli.capture.formats.text import read_lines, read_number_rows, to_number
from splinecli.capture.layouts.capture_files import LIGHT_POSITIONS, find_lights, find_named
from splinecli.capture.lights.lamp_checks import UNIT_HINT
from splinecli.capture.lights.light_files import read_light_positions
from splinecli.capture.lights.light_frames import LightFrame
from splinecli.capture.lights.near_lamps import NearLamps
from splinecli.capture.stamp import stamp_content
from splinecli.capture.window import Window
from splinecli.errors import InputError, UsageError
from splinecli.maths import Bools, Doubles
from splinecli.maths.normals import unit

PIXEL_SIZE = ("pixel_size.txt",)
CAMERA_MATRIX = ("camera_matrix.txt",)
LOBES = ("light_lobes.txt",)
_MOST_NARROW = 100  # the exponent of a lamp that has half of its light 7 degrees off its axis

SCALE_HINT = "Give --pixel-size or --object-width, or write the width of a pixel into pixel_size.txt"


class LitSource(Protocol):
    """What lamps need to know of an opened capture; see CaptureSource."""

    @property
    def n_lights(self) -> int: ...
    @property
    def light_directions(self) -> Doubles: ...
    @property
    def light_frame(self) -> LightFrame: ...
    @property
    def intensities_measured(self) -> bool: ...
    @property
    def window(self) -> Window: ...


@dataclass(frozen=True, kw_only=True)
class LampOptions:
    """What the user says about near lamps. All lengths have the same unit, such as millimetres.

    Raises:
        UsageError: a number is not above 0, or two options contradict each other.
    """

    positions: str | None = None  # a file of lamp positions, which replaces the light file
    distance: float | None = None  # of all lamps from the middle of the object, in their directions
    pixel_size: float | None = None  # the width of a pixel on the object's mean plane
    scales_surface: bool = False  # whether the pixel size is given for the surface, so that it needs no lamps
    object_width: float | None = None  # from the first to the last column of the mask
    camera_matrix: str | None = None  # a file of the 3 x 3 camera matrix in pixels

    def __post_init__(self) -> None:
        for name in ("distance", "pixel_size", "object_width"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise UsageError(f"the {name.replace('_', ' ')} is {value:g}, expected a number above 0")
        for one, other in (("positions", "distance"), ("pixel_size", "object_width")):
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise UsageError(f"{_OPTIONS[one]} and {_OPTIONS[other]} contradict each other", hint="Leave one out")
        if self.distance is not None and self.pixel_size is None and self.object_width is None:
            raise UsageError("--light-distance needs the size of a pixel", hint="Add --pixel-size or --object-width")

    @property
    def given(self) -> str | None:
        """The first option for lamps alone that is given, as the user writes it; None for none."""
        names = [name for name in _OPTIONS if not (name == "pixel_size" and self.scales_surface)]
        return next((_OPTIONS[name] for name in names if getattr(self, name) is not None), None)


_FARTHEST = 1e15  # of a lamp. float32 holds the squares of distances up to 1e19
_OPTIONS = {
    "positions": "--light-positions",
    "distance": "--light-distance",
    "pixel_size": "--pixel-size",
    "object_width": "--object-width",
    "camera_matrix": "--camera-matrix",
}

NO_LAMP_OPTIONS = LampOptions()


@dataclass(frozen=True, eq=False)
class LampFiles:
    """What files and options say of near lamps, before the lights and the images are read."""

    positions: Path | None  # the file of positions, or None where `distance` puts the lamps in the light directions
    distance: float | None  # see LampOptions, as for the scale. Both of its numbers are None where it is unknown
    pixel_size: float | None
    object_width: float | None
    camera_matrix: Doubles | None  # (3, 3), or None for an orthographic camera
    lobes: Path | None  # the file of the lamps' lobes, or None
    stamp: tuple[Any, ...]  # of the files that were found, from before they were read
    used: bool  # whether the capture uses the lamps. If not, they are only compared with distant lights

    def in_words(self) -> str:
        """Return the source of the lamps' positions, for people."""
        if not self.used:
            return f"{self.positions} is not used"
        what, width = ("a pixel", self.pixel_size) if self.object_width is None else ("the object", self.object_width)
        where = f"{self.distance:g} away" if self.positions is None else f"near, as in {self.positions}"
        return f"{where}; {what} is {width:g} wide" + ("" if self.lobes is None else f"; lobes as in {self.lobes}")

    def over(self, source: LitSource, mask: Bools, *, step: int = 1) -> NearLamps | None:
        """Return all lamps of a capture over a mask (H, W) with every step-th row and column; None without a scale."""
        window, frame, equal = source.window, source.light_frame, not source.intensities_measured
        if self.positions is not None:
            positions = read_light_positions(self.positions, source.n_lights, frame)
        else:
            assert self.distance is not None
            positions = source.light_directions * self.distance
        if (farthest := np.abs(positions).max(initial=0)) > _FARTHEST:
            raise InputError(f"a lamp is {farthest:.3g} away", path=self.positions, hint=UNIT_HINT)
        pixel_size, camera_matrix = self.pixel_size, self.camera_matrix
        if self.object_width is not None:
            columns = np.flatnonzero(mask.any(axis=0))
            pixel_size = self.object_width / float(columns[-1] - columns[0] + 1) / (step * window.step)
        if pixel_size is None:
            return None
        shape = tuple(step * size for size in mask.shape) if window.shape is None else window.shape
        lobes = None if self.lobes is None else _read_lobes(self.lobes, positions, frame)
        lamps = NearLamps.of(positions, pixel_size, shape, equal=equal, camera_matrix=camera_matrix, lobes=lobes)
        left, top, *_ = window.box or (0, 0)
        step *= window.step
        return lamps.within(left, top, step, None if camera_matrix is None else window.camera(camera_matrix))


def find_lamps(folder: Path, lights: Path | None, options: LampOptions) -> LampFiles | None:
    """Return what the capture's folder and the options say of near lamps; None for nothing.

    A file of positions in the folder is used, unless the user names a file `lights` of distant lights. Beside such a
    file, and where nothing tells the scale, positions are found but not used.

    Raises:
        InputError: a file is wrong, or positions are the only lights and their scale is unknown.
        UsageError: an option needs positions, and there are none.
    """
    positions, used = _find_positions(folder, lights, options)
    if positions is None and options.distance is None:
        if options.given is not None:
            problem = f"{options.given} concerns near lamps, and {folder} has no {LIGHT_POSITIONS[0]}"
            raise UsageError(problem, hint="Add --light-positions FILE or --light-distance D, or leave it out")
        return None
    folders = [folder, *([] if positions is None else [positions.parent])]
    matrix_file = _path(options.camera_matrix) or _find(folders, CAMERA_MATRIX)
    scaled = options.pixel_size is not None or options.object_width is not None
    pixel_file = None if scaled else _find(folders, PIXEL_SIZE)
    scaled = scaled or pixel_file is not None
    lobes = _find(folders, LOBES)
    files = (positions, pixel_file, matrix_file, lobes)
    stamp = tuple(stamp_content(path) for path in files if path is not None)
    pixel_size = options.pixel_size if pixel_file is None else _read_pixel_size(pixel_file)
    if used and not scaled and positions in (find_lights(folder), _path(options.positions)):
        raise InputError("nothing tells the scale of the lamps' positions", path=positions, hint=SCALE_HINT)
    matrix, width = None if matrix_file is None else read_camera_matrix(matrix_file), options.object_width
    return LampFiles(positions, options.distance, pixel_size, width, matrix, lobes, stamp, used and scaled)


def _find_positions(folder: Path, lights: Path | None, options: LampOptions) -> tuple[Path | None, bool]:
    """Return the file of positions, and whether to use positions rather than distant lights."""
    if options.positions is not None or options.distance is not None:
        return _path(options.positions), True
    in_folder = find_named(folder, LIGHT_POSITIONS)
    if lights is None or in_folder is not None or not lights.is_file():
        return in_folder, lights is None
    return find_named(lights.parent, LIGHT_POSITIONS), False


def _path(name: str | None) -> Path | None:
    return None if name is None else Path(name)


def read_camera_matrix(path: Path) -> Doubles:
    """Return the 3 x 3 numbers of a text file. Raises InputError."""
    matrix = read_number_rows(path).as_array()
    if matrix.shape != (3, 3):
        problem = f"found {matrix.shape[0]} x {matrix.shape[1]} numbers, expected 3 x 3"
        raise InputError(problem, path=path, hint="A camera matrix has the rows fx 0 cx, 0 fy cy and 0 0 1, in pixels")
    return matrix


def _read_lobes(path: Path, positions: Doubles, frame: LightFrame) -> Doubles:
    """Return the lobes (F, 4) of lamps at positions (F, 3); see NearLamps. Raises InputError."""
    hint = f"A line has the direction in which a lamp shines most, x y z, and its exponent mu, 0 to {_MOST_NARROW}"
    rows = read_number_rows(path).rows
    if len(rows) not in (1, len(positions)):
        raise InputError(f"found {len(rows)} lines, expected 1 or {len(positions)}", path=path, hint=hint)
    for numbers, line, text in rows:
        if len(numbers) != 4 or not any(numbers[:3]) or not 0 <= numbers[3] <= _MOST_NARROW:
            raise InputError(f'found "{text[:60]}", expected x y z mu', path=path, line=line, hint=hint)
    rows *= len(positions) // len(rows)
    lobes = np.array([row.numbers for row in rows])
    lobes[:, :3] = unit(lobes[:, :3] @ frame.matrix.T)
    away = np.einsum("fc,fc->f", lobes[:, :3], positions) >= 0
    if away.any():
        lamp = int(away.argmax())
        hint = "The directions point from the lamps to the object"
        raise InputError(f"lamp {lamp + 1} shines away from the object", path=path, line=rows[lamp].line, hint=hint)
    return lobes


def _read_pixel_size(path: Path) -> float:
    lines = enumerate(read_lines(path, expected="a text file with one number"), start=1)
    content = [(line, text.partition("#")[0].strip()) for line, text in lines]
    content = [(line, text) for line, text in content if text] or [(1, "")]
    line, text = content[0]
    size = to_number(text) or 0.0
    if len(content) != 1 or not 0 < size < math.inf:
        problem = f'found "{text[:40]}", expected one number above 0, the width of a pixel'
        hint = "Write the number alone; its unit is that of the lamps' positions"
        raise InputError(problem, path=path, line=line, hint=hint)
    return size


def _find(folders: list[Path], names: tuple[str, ...]) -> Path | None:
    return next((path for folder in folders if (path := find_named(folder, names)) is not None), None)
