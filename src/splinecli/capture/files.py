"""The files of a capture: their names determine their roles, and stamps detect changes."""

from __future__ import annotations

import hashlib
import json
import os.path
import re
import stat
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splinecli.capture.formats.decoders import RAW_SUFFIXES, page_of, pages
from splinecli.capture.formats.film import is_film
from splinecli.capture.formats.mat import find_stack
from splinecli.capture.formats.numbers import read_lines, read_text
from splinecli.errors import InputError
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.records.capture_warnings import CaptureWarning
from splinecli.records.output_files import FOUND_LIGHTS, PLOTS, own_files
from splinecli.system.files import (
    check_file,
    file_sha256,
    find_mode,
    is_folder,
    is_found_file,
    is_substitution,
    reading,
    resolve,
)

_DEVELOPED = (".png", ".tif", ".tiff", ".bmp", ".tga")
_JPEG = (".jpg", ".jpeg")
# Treated as images only if the folder contains no others
_RARE = (".pgm", ".ppm", ".webp", ".avif", ".heic", ".heif")
PICTURE_SUFFIXES = (*_DEVELOPED, *_JPEG, *_RARE)  # suffixes of pictures such as masks
_KINDS = (_DEVELOPED, RAW_SUFFIXES, _JPEG, _RARE)  # of one photograph, the best kind first
# Suffixes of images of an object
IMAGE_SUFFIXES = tuple(suffix for suffixes in _KINDS for suffix in suffixes)

FILENAMES = "filenames.txt"
LIGHT_POSITIONS = ("light_positions.txt",)
MASK = tuple(f"mask{suffix}" for suffix in PICTURE_SUFFIXES)
AMBIENT = tuple(f"ambient{suffix}" for suffix in IMAGE_SUFFIXES)
GROUND_TRUTH = tuple(
    f"{stem}{suffix}"
    for suffix in (".mat", ".npy", ".png", ".tif", ".tiff", ".txt", ".bmp")
    for stem in ("normal_gt", "normals_gt", "gt_normal", "gt_normals")
)

# Subfolders that may hold a capture's images while its other files are in the parent folder. PSBox
# uses the first name.
IMAGE_FOLDERS = ("Objects", "objects", "images", "Images")
NOT_PHOTOGRAPHS = frozenset(
    Path(name).stem
    for name in (*MASK, *AMBIENT, *GROUND_TRUTH, *own_files(), *FOUND_LIGHTS, *PLOTS)
    if Path(name).suffix in IMAGE_SUFFIXES
)
"""Lower-case stems of pictures that are not photographs under one light. They include results,
which may have been written to the capture's folder.
"""


class NoImagesError(InputError):
    """A folder contains no images."""


def natural_key(path: Path) -> tuple[list[int | str], str]:
    """Return a sort key that compares numbers by value, so that img2 comes before img10."""
    # With a group, split() alternates text and digits, so items at equal positions can be compared.
    parts = enumerate(re.split(r"([0-9]+)", path.name.casefold()))
    return [int(part) if place % 2 else part for place, part in parts], path.name


# Words in the names of pictures that are not photographs
ROLES = {
    # matches faceMask and facemask, but not damask
    "mask": re.compile(r"((?<![a-z])m|(?<=[a-z])M)asks?(?![a-z])|(?<=[a-z])(?<!da)masks?$"),
    "ambient": re.compile(r"(?<![a-z])ambient(?![a-z])"),
}


def has_role(path: Path, role: str) -> bool:
    """Return whether a picture's name contains the word "mask" or "ambient", as in NAME_mask.png.

    Names reserved for other files do not count.
    """
    if path.suffix.lower() not in PICTURE_SUFFIXES or path.stem.lower() in NOT_PHOTOGRAPHS:
        return False
    return any(ROLES[role].search(name) for name in (path.stem, path.stem.lower()))


def list_folder(folder: Path) -> list[Path]:
    """Return the visible entries of a folder in natural order.

    Hidden files are skipped, because macOS writes a "._" companion next to each image. Raises
    InputError if the folder is missing, is a file, or cannot be read.
    """
    mode = find_mode(folder)
    if mode is None:
        raise InputError("the folder does not exist", folder)
    if not stat.S_ISDIR(mode):
        raise InputError(
            "found a file, expected a folder of images",
            folder,
            hint=f"Pass the folder that contains it, {folder.parent}",
        )
    with reading(folder, "folder"):
        entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
        return sorted(entries, key=natural_key)


def list_images(
    folder: Path,
    *,
    leave_out_stems: Collection[str] = NOT_PHOTOGRAPHS,
    leave_out: Collection[Path] = (),
) -> tuple[Path, ...]:
    """Return the images in a folder, identified by their suffixes, in natural order.

    Files with the same stem are assumed to show the same photograph. A PNG or TIFF file takes
    precedence over a RAW file, from which it was probably developed. A JPEG file is ignored,
    because it is usually a copy made by the camera or a viewer. Files with another role are
    excluded: those whose lower-case stem is in leave_out_stems, such as "mask"; those that the user
    named; and those whose names contain the word of a role, unless the names of all images do.
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
    images = [
        image for image in images if not any(has_role(image, role) for role in ROLES)
    ] or images
    usual = [image for image in images if image.suffix.lower() not in _RARE]
    if usual and not len(usual) < MIN_LIGHTS <= len(images) - len(usual):
        images = usual
    rank = {suffix: rank for rank, suffixes in enumerate(_KINDS) for suffix in suffixes}
    best: dict[str, int] = {}
    for image in images:
        stem, own = image.stem.lower(), rank[image.suffix.lower()]
        best[stem] = min(own, best.get(stem, own))
    return tuple(
        image for image in images if rank[image.suffix.lower()] == best[image.stem.lower()]
    )


def check_not_empty(images: Sequence[Path], folder: Path) -> None:
    """Raise NoImagesError if the folder contains no images."""
    if not images:
        suffixes = Counter(
            path.suffix.lower() for path in list_folder(folder) if path.suffix and not path.is_dir()
        )
        found = ", ".join(
            f"{count} {suffix} file{'s' * (count > 1)}" for suffix, count in suffixes.most_common(3)
        )
        hint = (
            "Images can be PNG, TIFF, JPEG, BMP, TGA, PGM, PPM, WebP, AVIF, HEIC or RAW files, or"
            " a single .mat file with a numeric array H x W x F"
        )
        if films := list(filter(is_film, list_folder(folder))):
            hint = f"Pass the video itself, as in: splinecli infer {films[0]}"
        inside = [path for path in list_folder(folder) if is_folder(path) and list_images(path)]
        if inside:
            hint = f"Pass the folder with the images, such as {inside[0]}"
        raise NoImagesError(
            "the folder contains no images" + (f", but {found}" if found else ""),
            folder,
            hint=hint,
        )


def read_image_list(path: Path) -> tuple[Path, ...]:
    """Return the images listed in a filenames.txt, one per line, relative to its folder.

    Raises InputError if the list is empty, or with the line if an image is listed twice or does not
    exist.
    """
    images: dict[Path, int] = {}
    for line, text in enumerate(read_lines(path), start=1):
        name = text.strip()
        if not name:
            continue
        places = (path.parent / each / name for each in ("", *IMAGE_FOLDERS))
        # Path.exists raises an error for a name that is too long
        image = next(filter(os.path.exists, places), None)
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise InputError(
                f'the image "{name}" is outside the folder of the list',
                path,
                line=line,
                hint="Copy the image into the folder, or create a link to it there, and list that"
                " name",
            )
        if image is None:
            raise InputError(
                f'the image "{name}" does not exist',
                path,
                line=line,
                hint="Correct the name or remove the line",
            )
        check_file(image, "an image")
        if image in images:
            raise InputError(
                f'the image "{name}" is already listed on line {images[image]}', path, line=line
            )
        images[image] = line
    if not images:
        raise InputError("the list contains no images", path)
    return tuple(images)


def find_images(
    folder: Path,
    *,
    leave_out_stems: Collection[str] = NOT_PHOTOGRAPHS,
    leave_out: Collection[Path],
) -> tuple[tuple[Path, ...], bool]:
    """Return the images of a folder, and whether filenames.txt lists them. See list_images.

    Raises NoImagesError for a folder without images, and InputError for an invalid filenames.txt.
    """
    filenames = find_named(folder, [FILENAMES])
    if filenames is not None:
        return read_image_list(filenames), True
    images = list_images(folder, leave_out_stems=leave_out_stems, leave_out=leave_out)
    images = images or list_stack(folder)
    check_not_empty(images, folder)
    if len(images) == 1 and images[0].suffix.lower() in (".tif", ".tiff"):
        images = tuple(pages(images[0]))
    return images, False


def list_stack(folder: Path) -> tuple[Path, ...]:
    """Return the photographs in the only .mat file of a folder, such as a.mat[0], or an empty tuple
    without such a file.

    Raises InputError if several files contain photographs.
    """
    found, unread = dict[Path, int](), None
    for path in list_folder(folder):
        if path.suffix.lower() == ".mat" and path.name.lower() not in GROUND_TRUTH:
            try:
                if is_found_file(path) and (stack := find_stack(path)) is not None:
                    found[path] = stack.count
            except InputError as error:
                unread = error
    if len(found) > 1:
        raise InputError(
            f"found {len(found)} .mat files with photographs ({short_list([*found])}), expected"
            " one",
            folder,
            hint="Put each capture in its own folder",
        )
    if unread is not None and not found:
        raise unread
    return tuple(
        path.with_name(f"{path.name}[{n}]") for path, count in found.items() for n in range(count)
    )


def short_list(paths: Sequence[Path], most: int = 3) -> str:
    """Return the names of the first files, for use in a message."""
    return ", ".join(path.name for path in paths[:most]) + (", ..." if len(paths) > most else "")


@dataclass(frozen=True)
class CaptureFiles:
    """The files of one capture, with the images in the order of the lights."""

    layout: str  # readable name of the layout
    name: str  # name of the capture, usually the folder's name
    folder: Path  # the folder that contains the other files
    images: tuple[Path, ...]
    # F x 3 text, or a file that names the images and thereby defines their order. None if no lights
    # are needed
    light_directions: Path | None
    light_intensities: Path | None = None  # F x 3 text, or None if there is no such file
    mask: Path | None = None  # an image, or None to use every pixel
    ground_truth: Path | None = None  # a normal map, or None
    # used instead of a mask: the object is the union of the non-zero pixels of these images
    boundaries: tuple[Path, ...] = ()
    ambient: Path | None = None  # an image taken with all lights off, or None
    # pictures next to the images whose names show that they are not photographs
    others: tuple[Path, ...] = ()
    # zero-based positions of the images in the light file, or None if it has no others
    kept: tuple[int, ...] | None = None
    warnings: tuple[CaptureWarning, ...] = ()  # about choices among files with unusual names


@dataclass(frozen=True)
class Overrides:
    """Files named by the user, which take precedence over the files in the folder.

    If needs_lights is false, light files in the folder are ignored, and it is not an error if there
    are none.
    """

    lights: Path | None = None
    intensities: Path | None = None
    mask: Path | None = None
    ground_truth: Path | None = None
    needs_lights: bool = field(default=True, kw_only=True)

    def named(self) -> tuple[Path, ...]:
        """Return the files named by the user. Raises InputError for a path that is not a file."""
        given = self.lights, self.intensities, self.mask, self.ground_truth
        files = tuple(file for file in given if file is not None)
        for file in files:
            check_file(file, "a file", pipe=file == self.lights)
        return files


def find_named(folder: Path, names: Sequence[str]) -> Path | None:
    """Return the first file in the folder with one of these names, ignoring case, or None. Earlier
    names take precedence.
    """
    entries = {entry.name.lower(): entry for entry in list_folder(folder)}
    files = (entries[name] for name in names if name in entries)
    return next(filter(is_found_file, files), None)


def folder_name(folder: Path) -> str:
    """Return the name of a folder, even if its path is ".", ".." or ends with a slash.

    A link keeps its own name. Raises InputError.
    """
    path = folder.absolute()
    return (resolve(path) if ".." in path.parts else path).name or "capture"


def stamp_files(
    files: CaptureFiles, flat_field: Sequence[Path], lamps: Sequence[Any]
) -> tuple[Any, ...]:
    """Return JSON values that change whenever a file of the capture changes.

    Compute them before reading the files. Images and flat fields are stamped with their path, size
    and modification time, because reading them is slow. All other files (lights, intensities, mask,
    ground truth, ambient image) are stamped with their content. Raises InputError if a file cannot
    be read.
    """
    lights = files.light_directions, files.light_intensities
    small = *files.boundaries, *lights, files.mask, files.ground_truth, files.ambient
    # If the lights are in the names of the images, light_directions is a folder.
    paths = [path for path in small if path is not None and not is_folder(path)]
    contents = [stamp_content(page_of(path)[0]) for path in paths]
    return (
        [*contents, *lamps],
        [*map(_path_size_and_time, files.images)],
        [*map(_path_size_and_time, flat_field)],
    )


def stamp_content(path: Path) -> Any:
    """Return the SHA-256 of a file or, above 64 MiB, its path, size and modification time.

    Raises InputError.
    """
    check_file(path, "a file", pipe=True)
    if is_substitution(path):
        return hashlib.sha256(read_text(path)).hexdigest()
    with reading(path):
        return file_sha256(path) if path.stat().st_size <= 1 << 26 else _path_size_and_time(path)


def digest(stamp: Sequence[Any]) -> str:
    """Return the SHA-256 of a stamp, or of any JSON values, as hexadecimal digits."""
    return hashlib.sha256(json.dumps(stamp).encode()).hexdigest()


def _path_size_and_time(path: Path) -> tuple[str, int, int]:
    stored, page = page_of(path)
    with reading(path):
        status = stored.stat()
        return str(stored.resolve()) + f"[{page}]" * (page > 0), status.st_size, status.st_mtime_ns
