"""Files and options that describe near lamps and the camera: positions, lobes, the pixel size, and
the light.mat and camera.mat files of near_ps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from splinecli.capture.files import LIGHT_POSITIONS, find_named, list_folder, stamp_content
from splinecli.capture.formats.mat import names, read_matrix
from splinecli.capture.formats.numbers import NumberRow, read_lines, read_number_rows, to_number
from splinecli.capture.light_files import FORMATS, format_of, read_light_positions
from splinecli.capture.light_rows import LightFrame, read_light_rows, usable_intensities
from splinecli.capture.light_search import find_light_file, light_folders
from splinecli.capture.linearise import Window
from splinecli.capture.near_lamps import UNIT_HINT, NearLamps, within_lobes
from splinecli.errors import InputError, UsageError
from splinecli.maths import Array, Bools, Float64Array
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import bounds, ray_basis
from splinecli.records.capture_warnings import NEAR_LAMPS, CaptureWarning
from splinecli.system.files import is_found_file, is_substitution


def positions_as_directions(path: Path) -> list[CaptureWarning]:
    """Return a warning if the vectors in a text file of directions have lengths typical of
    positions.
    """
    if is_substitution(path) or format_of(path).read != FORMATS[0].read:
        return []
    try:
        vectors = read_light_rows(path, expected="x y z", n_numbers=3).as_array()
    except InputError:
        return []  # a file of angles
    vectors = vectors.T if vectors.shape[1] != 3 and vectors.shape[0] == 3 else vectors[:, -3:]
    lengths = np.hypot.reduce(vectors, axis=1)
    if len(lengths) < 3 or lengths.min() < 3.0 or lengths.max() < 1.02 * lengths.min():
        return []
    text = (
        f"{path.name} was read as light directions, but the lengths of its vectors, from"
        f" {lengths.min():.4g} to {lengths.max():.4g}, are typical of lamp positions. If they are"
        " positions, use --light-positions."
    )
    return [CaptureWarning(NEAR_LAMPS, text)]


@dataclass(frozen=True, kw_only=True)
class LampOptions:
    """The user's options for near lamps and the camera. All lengths are in one unit, such as
    millimetres.

    Positions take precedence over a distance, and a pixel size over the object's width. Raises
    UsageError if a distance is given without a pixel size or an object width.
    """

    positions: str | None = None  # a file of lamp positions, which replaces the light file
    distance: float | None = None  # from the middle of the object to every lamp
    pixel_size: float | None = None  # the width of a pixel on the object's mean plane
    # whether the pixel size is also used to scale the surface, so that it is valid without lamps
    scales_surface: bool = False
    object_width: float | None = None  # the width from the first to the last column of the mask
    camera_matrix: str | None = None  # a file with the 3 x 3 camera matrix in pixels

    def __post_init__(self) -> None:
        if self.distance is not None and self.pixel_size is None and self.object_width is None:
            raise UsageError(
                "--light-distance requires the size of a pixel",
                hint="Add --pixel-size or --object-width",
            )

    @property
    def given(self) -> str | None:
        """The first option that requires near lamps, as the user wrote it, or None."""
        names = [name for name in _OPTIONS if not (name == "pixel_size" and self.scales_surface)]
        return next((_OPTIONS[name] for name in names if getattr(self, name) is not None), None)


_OPTIONS = {
    "positions": "--light-positions",
    "distance": "--light-distance",
    "pixel_size": "--pixel-size",
    "object_width": "--object-width",
}

NO_LAMP_OPTIONS = LampOptions()


class Lit(Protocol):
    """The properties of a source that near lamps depend on."""

    @property
    def n_lights(self) -> int: ...
    @property
    def light_directions(self) -> Float64Array: ...
    @property
    def light_frame(self) -> LightFrame: ...
    @property
    def intensities_measured(self) -> bool: ...
    @property
    def camera_matrix(self) -> Float64Array | None: ...
    @property
    def window(self) -> Window: ...


@dataclass(frozen=True, eq=False)
class LampFiles:
    """Near lamps as described by files and options, before the lights and images are read."""

    # the file of positions, or None if the lamps are at `distance` in the light directions
    positions: Path | None
    options: LampOptions
    # from the options or a file. Both this and the object's width are None if the scale is unknown
    pixel_size: float | None
    lobes: Path | None  # the file of the lamps' lobes, or None
    stamp: tuple[Any, ...]  # of the files found, computed before they were read
    # whether the capture uses the lamps; otherwise, they are only compared with distant lights
    used: bool

    def in_words(self) -> str:
        """Return a description of the lamps and where they come from."""
        if not self.used:
            return f"{self.positions} is not used"
        text = f"near, as in {self.positions}"
        if self.positions is None:
            text = f"{self.options.distance:g} away"
        if self.options.object_width is None:
            text += f"; a pixel is {self.pixel_size:g} wide"
        else:
            text += f"; the object is {self.options.object_width:g} wide"
        return text if self.lobes is None else f"{text}; lobes as in {self.lobes}"

    def over(self, source: Lit, mask: Bools, *, step: int = 1) -> NearLamps | None:
        """Return all lamps for a mask (H, W) of every step-th row and column, or None if the scale
        is unknown.

        Raises InputError.
        """
        window, camera_matrix = source.window, source.camera_matrix
        if self.positions is not None:
            positions = read_light_positions(self.positions, source.n_lights, source.light_frame)
        else:
            assert self.options.distance is not None
            positions = source.light_directions * self.options.distance
        # float32 can represent the squares of distances up to 1e19.
        if (farthest := np.abs(positions).max(initial=0)) > 1e15:
            raise InputError(
                f"a lamp is {farthest:.3g} away, expected at most 1e15",
                self.positions,
                hint=UNIT_HINT,
            )
        pixel_size = self.pixel_size
        if self.options.object_width is not None:
            _, (first, last) = bounds(mask)
            pixel_size = self.options.object_width / float(last - first + 1) / (step * window.step)
        if pixel_size is None:
            return None
        shape = tuple(step * size for size in mask.shape) if window.shape is None else window.shape
        lobes = self.lobes
        lamps = NearLamps.of(
            positions,
            pixel_size,
            shape,
            equal=not source.intensities_measured,
            camera_matrix=camera_matrix,
            lobes=None if lobes is None else _read_lobes(lobes, positions, source.light_frame),
        )
        left, top, *_ = window.box or (0, 0)
        step *= window.step
        return lamps.within(
            left, top, step, None if camera_matrix is None else window.camera(camera_matrix)
        )


def find_lamps(folder: Path, lights: Path | None, options: LampOptions) -> LampFiles | None:
    """Return the near lamps described by the capture's folder and the options, or None.

    A file of positions in the folder is used unless the user passes `lights`, a file of distant
    lights. If `lights` is given or the scale is unknown, the positions are returned but not used.

    Raises:
        InputError: a file is invalid, or positions are the only lights and their scale is unknown.
        UsageError: an option needs positions, but none are given.
    """
    positions, used = _path(options.positions), True
    if positions is None and options.distance is None:
        positions, used = find_named(folder, LIGHT_POSITIONS), lights is None
        if positions is None and used and find_light_file(folder) is None:
            places = folder, *light_folders(folder)
            entries = (path for place in places for path in list_folder(place))
            positions = next(filter(is_near_ps, entries), None)
        if positions is None and lights is not None and lights.is_file():
            positions = find_named(lights.parent, LIGHT_POSITIONS)
        if positions is None:
            if options.given is None:
                return None
            raise UsageError(
                f"{options.given} requires near lamps, but {folder} contains no"
                f" {LIGHT_POSITIONS[0]}",
                hint="Add --light-positions FILE or --light-distance D, or omit the option",
            )
    scaled = options.pixel_size is not None or options.object_width is not None
    pixel_file = None if scaled else _find("pixel_size.txt", folder, positions)
    scaled = scaled or pixel_file is not None
    lobes = _find("light_lobes.txt", folder, positions)
    if lobes is None and positions is not None and is_near_ps(positions):
        lobes = positions
    stamp = tuple(map(stamp_content, filter(None, (positions, pixel_file, lobes))))
    pixel_size = options.pixel_size if pixel_file is None else _read_pixel_size(pixel_file)
    only = find_light_file(folder), _path(options.positions), lobes
    if used and not scaled and positions in only:
        hint = "Add --pixel-size or --object-width, or write the width of a pixel to pixel_size.txt"
        if positions == lobes:
            hint = (
                "Add --pixel-size: the distance from the camera to the object divided by the"
                " focal length in pixels (K(1,1) in camera.mat)"
            )
        raise InputError("the scale of the lamp positions is unknown", positions, hint=hint)
    return LampFiles(positions, options, pixel_size, lobes, stamp, used and scaled)


def find_camera(
    folder: Path, lamps: LampFiles | None, options: LampOptions
) -> tuple[Float64Array | None, tuple[Any, ...]]:
    """Return the camera matrix (3, 3) of whole images and the stamp of its file.

    The matrix is None for an orthographic camera. Raises InputError if the file is invalid.
    """
    beside = None if lamps is None else lamps.positions
    path = _path(options.camera_matrix) or _find("camera_matrix.txt", folder, beside)
    if path is None and beside is not None and is_near_ps(beside):
        path = find_named(beside.parent, ["camera.mat"])
    if path is None:
        return None, ()
    stamp = stamp_content(path)  # computed before the file is read
    return read_camera_matrix(path), (stamp,)


def _path(name: str | None) -> Path | None:
    return None if name is None else Path(name)


def read_camera_matrix(path: Path) -> Float64Array:
    """Return the camera matrix (3, 3) from a text file, or from K in a .mat file. Raises
    InputError.
    """
    if path.suffix.lower() == ".mat":
        matrix: Float64Array = np.asarray(_matrix_of(path, "K"), np.float64)
    else:
        matrix = read_number_rows(path).as_array()
    if matrix.shape != (3, 3):
        raise InputError(
            f"found {matrix.shape[0]} x {matrix.shape[1]} numbers, expected 3 x 3",
            path,
            hint="A camera matrix has the rows fx 0 cx, 0 fy cy and 0 0 1, in pixels",
        )
    ray_basis(matrix)  # rejects invalid matrices
    return matrix


def _read_lobes(path: Path, positions: Float64Array, frame: LightFrame) -> Float64Array:
    """Return the lobes (F, 4) of lamps at positions (F, 3), as in NearLamps. Raises InputError."""
    hint = (
        "Each line gives the direction x y z in which a lamp is brightest, and its exponent mu from"
        " 0 to 100"
    )
    if is_near_ps(path):
        columns = np.column_stack((_rows_of(path, "Dir"), _rows_of(path, "mu", 1)))
        rows = tuple(NumberRow(tuple(row), None) for row in columns.tolist())
    else:
        rows = read_number_rows(path).rows
    if len(rows) not in (1, len(positions)):
        raise InputError(
            f"found {len(rows)} lines, expected 1 or {len(positions)}", path, hint=hint
        )
    for numbers, line, text in rows:
        # With an exponent of 100, the intensity falls to half 7 degrees off the axis.
        if len(numbers) != 4 or not any(numbers[:3]) or not 0 <= numbers[3] <= 100:
            raise InputError(f'found "{text[:60]}", expected x y z mu', path, line=line, hint=hint)
    rows *= len(positions) // len(rows)
    lobes = np.array([row.numbers for row in rows])
    lobes[:, :3] = unit(lobes[:, :3] @ frame.matrix.T)
    away = np.einsum("fc,fc->f", lobes[:, :3], positions) >= 0
    if away.any():
        lamp = int(away.argmax())
        raise InputError(
            f"lamp {lamp + 1} shines away from the object",
            path,
            line=rows[lamp].line,
            hint="The directions must point from the lamps to the object",
        )
    return lobes


def is_near_ps(path: Path) -> bool:
    """Return whether a file is a light.mat in the format of near_ps (Y. Quéau).

    Such a file contains the positions S and axes Dir of the lamps, in OpenCV's camera frame.
    """
    with suppress(InputError):
        return path.suffix.lower() == ".mat" and is_found_file(path) and {"S", "Dir"} <= names(path)
    return False


def _matrix_of(path: Path, name: str) -> Array:
    def choose(shapes: dict[str, tuple[int, ...]]) -> str:
        if name not in shapes:
            raise InputError(f"found no matrix {name}", path)
        return name

    return read_matrix(path, choose)


def _rows_of(path: Path, name: str, n_columns: int = 3) -> Float64Array:
    """Return a matrix (F, n_columns) from a .mat file, which may contain its transpose."""
    matrix = np.asarray(_matrix_of(path, name), np.float64)
    return matrix if matrix.shape[1] == n_columns else matrix.T


def near_ps_frame(
    lamps: LampFiles, camera_matrix: Float64Array | None, shape: Sequence[int]
) -> LightFrame:
    """Return the frame of near_ps lamp positions for images of shape (H, W).

    Raises InputError without a camera matrix or a pixel size.
    """
    if camera_matrix is None or lamps.pixel_size is None:
        raise InputError(
            "the positions are relative to the camera, so the camera matrix and the size of a pixel"
            " are needed",
            lamps.positions,
            hint="Add --camera-matrix and --pixel-size",
        )
    (fx, _, cx), (_, fy, cy), _ = camera_matrix
    distance = lamps.pixel_size * fx
    x = distance * (cx - (shape[1] - 1) / 2) / fx
    y = distance * ((shape[0] - 1) / 2 - cy) / fy
    return LightFrame((1, -1, -1), origin=(float(x), float(y), float(distance)))


def near_ps_intensities(path: Path, frame: LightFrame) -> Float64Array | None:
    """Return the light intensities (F, 3) of near_ps lamps at the origin, computed from Phi.

    Return None if the file has no Phi. Raises InputError.
    """
    if "Phi" not in names(path):
        return None
    towards = _rows_of(path, "S") @ frame.matrix.T + frame.origin
    flux = np.asarray(_matrix_of(path, "Phi"), np.float64)
    flux = flux if len(flux) == len(towards) else flux.T
    distances = np.linalg.norm(towards, axis=1, keepdims=True)
    lobes = _read_lobes(path, towards, frame)
    values = flux / distances**2 * within_lobes(lobes, (towards / distances)[None]).T
    if values.shape[1] not in (1, 3) or not usable_intensities(values).all():
        raise InputError(f"found Phi of shape {flux.shape}, expected positive numbers F x 1", path)
    return np.broadcast_to(values, towards.shape).copy()


def _read_pixel_size(path: Path) -> float:
    lines = enumerate(read_lines(path, expected="a text file with one number"), start=1)
    content = [(line, text) for line, row in lines if (text := row.partition("#")[0].strip())]
    line, text = content[0] if content else (1, "")
    size = to_number(text) or 0.0
    if len(content) != 1 or not 0 < size < math.inf:
        raise InputError(
            f'found "{text[:40]}", expected one number above 0, the width of a pixel',
            path,
            line=line,
            hint="Write only the number, in the unit of the lamp positions",
        )
    return size


def _find(name: str, folder: Path, positions: Path | None) -> Path | None:
    """Return the file with this name in the folder, or else next to the file of positions."""
    return find_named(folder, [name]) or (positions and find_named(positions.parent, [name]))
