"""The files of a capture: their names, by which they are recognised, and their stamps, by which changes are."""

from __future__ import annotations

import hashlib
import json
import os.path
import re
import stat
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splinecli.capture.formats.decoders import RAW_SUFFIXES
from splinecli.capture.formats.numbers import read_lines, read_text
from splinecli.errors import InputError
from splinecli.output_files import FOUND_LIGHTS, PLOTS, own_files
from splinecli.output_files import MAPS as MAPS
from splinecli.output_files import NORMALS as NORMALS
from splinecli.output_files import SCALED_MAPS as SCALED_MAPS
from splinecli.system.files import check_file, file_sha256, find_mode, is_found_file, is_substitution, reading, resolve

_DEVELOPED = (".png", ".tif", ".tiff", ".bmp", ".tga")
_JPEG = (".jpg", ".jpeg")
PICTURE_SUFFIXES = (*_DEVELOPED, *_JPEG)  # suffixes of pictures, such as masks
IMAGE_SUFFIXES = (*_DEVELOPED, *RAW_SUFFIXES, *_JPEG)  # suffixes of images of an object

_DIGITS = re.compile(r"([0-9]+)")


class NoImagesError(InputError):
    """A folder contains no images."""


def natural_key(path: Path) -> tuple[list[int | str], str]:
    """Return a sort key that compares numbers by value: img2 comes before img10."""
    # split() with a group alternates text and digits, so equal positions have equal types.
    parts = enumerate(_DIGITS.split(path.name.casefold()))
    return [int(part) if place % 2 else part for place, part in parts], path.name


def list_folder(folder: Path) -> list[Path]:
    """Return the folder's content in natural order, without hidden files (macOS writes "._" companions of images).

    Raises InputError where the folder is missing, is a file, or cannot be read.
    """
    mode = find_mode(folder)
    if mode is None:
        raise InputError("the folder does not exist", path=folder)
    if not stat.S_ISDIR(mode):
        raise InputError("found a file, expected a folder of images", path=folder)
    with reading(folder, "folder"):
        return sorted((entry for entry in folder.iterdir() if not entry.name.startswith(".")), key=natural_key)


def list_images(
    folder: Path, *, leave_out_stems: Collection[str], leave_out: Collection[Path] = ()
) -> tuple[Path, ...]:
    """Return the images of the folder in natural order, by their suffixes.

    Files that share a stem with a RAW file show the same photograph. A PNG or TIFF was developed from the RAW file and
    replaces it. A JPEG is a copy that the camera made, and does not count. What is left out has another meaning, by its
    stem in lower case, such as "mask", or as a file that the user named.
    """
    others = {resolve(path) for path in leave_out}
    images = [
        entry
        for entry in list_folder(folder)
        if entry.suffix.lower() in IMAGE_SUFFIXES
        and entry.stem.lower() not in leave_out_stems
        and is_found_file(entry)
        and resolve(entry) not in others
    ]
    names = [(image.stem.lower(), image.suffix.lower()) for image in images]
    raw = {stem for stem, suffix in names if suffix in RAW_SUFFIXES}
    developed = {stem for stem, suffix in names if suffix in _DEVELOPED}
    return tuple(
        image
        for image, (stem, suffix) in zip(images, names, strict=True)
        if stem not in raw or suffix in (_DEVELOPED if stem in developed else RAW_SUFFIXES)
    )


def check_not_empty(images: Sequence[Path], folder: Path) -> None:
    """Raise NoImagesError if there are no images."""
    if not images:
        raise NoImagesError(
            "the folder contains no images", path=folder, hint="PNG, TIFF, JPEG, BMP, TGA and RAW files count as images"
        )


def read_image_list(path: Path) -> tuple[Path, ...]:
    """Return the images that a filenames.txt names, one on each line, relative to its folder.

    Raises InputError with the line for an image that does not exist or is named twice; also for an empty list.
    """
    images: dict[Path, int] = {}
    for line, text in enumerate(read_lines(path), start=1):
        name = text.strip()
        if not name:
            continue
        image = path.parent / name
        if Path(name).is_absolute() or ".." in Path(name).parts:
            hint = "Copy the image into the folder, or set a link to it there, and name that"
            raise InputError(f'the image "{name}" is outside of this folder', path=path, line=line, hint=hint)
        if not os.path.exists(image):  # noqa: PTH110 - Path.exists raises for a name that is too long
            hint = "Correct the name or remove the line"
            raise InputError(f'the image "{name}" does not exist', path=path, line=line, hint=hint)
        check_file(image, "an image")
        if image in images:
            raise InputError(f'the image "{name}" is also on line {images[image]}', path=path, line=line)
        images[image] = line
    if not images:
        raise InputError("the list names no images", path=path)
    return tuple(images)


def find_images(
    folder: Path, *, leave_out_stems: Collection[str], leave_out: Collection[Path]
) -> tuple[tuple[Path, ...], bool]:
    """Return the images of a folder, and whether filenames.txt names them; see list_images.

    Raises NoImagesError for a folder without images, InputError for a wrong filenames.txt.
    """
    filenames = find_named(folder, [FILENAMES])
    if filenames is not None:
        return read_image_list(filenames), True
    images = list_images(folder, leave_out_stems=leave_out_stems, leave_out=leave_out)
    check_not_empty(images, folder)
    return images, False


FILENAMES = "filenames.txt"
LIGHT_DIRECTIONS = ("light_directions.txt", "lights.txt", "light_directions.npy", "lights.npy")
_NAMED_LIGHTS = (".lp", "lights.json")  # endings of the names of light files that name the image of each light
LIGHT_POSITIONS = ("light_positions.txt",)
LIGHT_FILES = "light_directions.txt, lights.txt, *.lp, lights.json or light_positions.txt"
"""The usual names of light files, for messages."""
LIGHT_INTENSITIES = ("light_intensities.txt",)
MASK = tuple(f"mask{suffix}" for suffix in PICTURE_SUFFIXES)
AMBIENT = tuple(f"ambient{suffix}" for suffix in IMAGE_SUFFIXES)
GROUND_TRUTH = tuple(
    f"{stem}{suffix}"
    for suffix in (".mat", ".npy", ".png", ".tif", ".tiff", ".txt")
    for stem in ("normal_gt", "normals_gt", "gt_normal", "gt_normals")
)

NOT_PHOTOGRAPHS = frozenset(
    Path(name).stem
    for name in (*MASK, *AMBIENT, *GROUND_TRUTH, *own_files(), *FOUND_LIGHTS, *PLOTS)
    if Path(name).suffix in IMAGE_SUFFIXES
)
"""Lower-case stems of pictures in a capture's folder that are not images of the object under one light. The folder of
results may be the same."""


@dataclass(frozen=True)
class CaptureFiles:
    """The files of one capture, with the images in the order of the lights."""

    layout: str  # name of the arrangement of files, for people
    name: str  # name of the capture, in most layouts that of its folder
    folder: Path  # the folder with the files beside the images
    images: tuple[Path, ...]
    # F x 3 text, or a file that names images, which sets the order of the images; None where no lights are needed
    light_directions: Path | None
    light_intensities: Path | None = None  # F x 3 text, or None where no file gives them
    mask: Path | None = None  # an image, or None where every pixel counts
    ground_truth: Path | None = None  # a normal map, or None
    boundaries: tuple[Path, ...] = ()  # used instead of a mask: images whose pixels above zero together are the object
    ambient: Path | None = None  # an image under none of the lights, or None
    others: tuple[Path, ...] = ()  # pictures beside the images whose names say that they are no photographs


@dataclass(frozen=True)
class Overrides:
    """Files named by the user, which replace those in the folder.

    Without needs_lights, light files in the folder do not count, and none is missed.
    """

    lights: Path | None = None
    intensities: Path | None = None
    mask: Path | None = None
    ground_truth: Path | None = None
    needs_lights: bool = field(default=True, kw_only=True)

    def named(self) -> tuple[Path, ...]:
        """Return the files that are given. Raises InputError for one that is no file."""
        files = tuple(f for f in (self.lights, self.intensities, self.mask, self.ground_truth) if f is not None)
        for file in files:
            check_file(file, "a file", pipe=file == self.lights)
        return files


NO_OVERRIDES = Overrides()


def find_named(folder: Path, names: Sequence[str]) -> Path | None:
    """Return the file with the first of these names in the folder, ignoring case; None if there is none."""
    files = {entry.name.lower(): entry for entry in list_folder(folder) if entry.name.lower() in names}
    return next((files[name] for name in names if name in files and is_found_file(files[name])), None)


def find_lights(folder: Path) -> Path | None:
    """Return the light file in the folder; None for none. Raises InputError for several that name their images."""
    plain = find_named(folder, LIGHT_DIRECTIONS)
    if plain is not None:
        return plain
    named = [e for e in list_folder(folder) if e.name.lower().endswith(_NAMED_LIGHTS) and is_found_file(e)]
    if len(named) > 1:
        problem = f"found {len(named)} light files: {', '.join(path.name for path in named)}"
        raise InputError(problem, path=folder, hint="Choose one with --lights FILE")
    return named[0] if named else find_named(folder, LIGHT_POSITIONS)


def folder_name(folder: Path) -> str:
    """Return the folder's own name, also for ".", ".." and a trailing slash, of a link its name. Raises InputError."""
    path = folder.absolute()
    return (resolve(path) if ".." in path.parts else path).name or "capture"


LARGEST_HASHED = 1 << 26  # bytes of the largest file that is stamped by its content


def stamp_files(files: CaptureFiles, flat_field: Sequence[Path], lamps: Sequence[Any]) -> tuple[Any, ...]:
    """Return JSON values that change when a file of the capture does. Take them before the files are read.

    Images and flat fields are stamped by path, size and time of change, because reading them takes long. All other
    files (lights, intensities, mask, ground truth, ambient image) are stamped by their content.

    Raises:
        InputError: a file cannot be read.
    """
    small = (files.light_directions, files.light_intensities, files.mask, files.ground_truth, files.ambient)
    return (
        [*(stamp_content(path) for path in (*files.boundaries, *small) if path is not None), *lamps],
        [_path_size_and_time(path) for path in files.images],
        [_path_size_and_time(path) for path in flat_field],
    )


def stamp_content(path: Path) -> Any:
    """Return the SHA-256 of a file, or the path, size and time of change of a very large one. Raises InputError."""
    check_file(path, "a file", pipe=True)
    if is_substitution(path):
        return hashlib.sha256(read_text(path)).hexdigest()
    with reading(path):
        return file_sha256(path) if path.stat().st_size <= LARGEST_HASHED else _path_size_and_time(path)


def digest(stamp: Sequence[Any]) -> str:
    """Return the SHA-256 of a stamp, or of any JSON values, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(stamp).encode()).hexdigest()


def _path_size_and_time(path: Path) -> tuple[str, int, int]:
    with reading(path):
        status = path.stat()
        return str(path.resolve()), status.st_size, status.st_mtime_ns
