"""The images of a folder, and their order."""

from __future__ import annotations

import os.path
import re
import stat
from collections.abc import Collection, Sequence
from pathlib import Path

from splinecli.capture.formats.raw import RAW_SUFFIXES
from splinecli.capture.formats.text import read_lines
from splinecli.capture.paths import check_file, find_mode, is_found_file, resolve
from splinecli.errors import InputError

_DEVELOPED = (".png", ".tif", ".tiff", ".bmp", ".tga")
_JPEG = (".jpg", ".jpeg")
PICTURE_SUFFIXES = (*_DEVELOPED, *_JPEG)
"""Suffixes of pictures, such as masks."""
IMAGE_SUFFIXES = (*_DEVELOPED, *RAW_SUFFIXES, *_JPEG)
"""Suffixes of images of an object."""

_DIGITS = re.compile(r"([0-9]+)")


class NoImagesError(InputError):
    """A folder contains no images."""


def natural_key(path: Path) -> tuple[list[int | str], str]:
    """Return a sort key that compares numbers by value: img2 comes before img10."""
    # split() with a group alternates text and digits, so equal positions have equal types.
    parts: list[int | str] = [
        int(part) if place % 2 else part for place, part in enumerate(_DIGITS.split(path.name.casefold()))
    ]
    return parts, path.name


def list_folder(folder: Path) -> list[Path]:
    """Return the folder's content in natural order, without hidden files (macOS writes "._" companions of images).

    Raises:
        InputError: the folder is missing, is a file, or cannot be read.
    """
    mode = find_mode(folder)
    if mode is None:
        raise InputError("the folder does not exist", path=folder)
    if not stat.S_ISDIR(mode):
        raise InputError("found a file, expected a folder of images", path=folder)
    try:
        entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise InputError(f"the folder cannot be read ({error.strerror})", path=folder) from None
    return sorted(entries, key=natural_key)


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
            "the folder contains no images",
            path=folder,
            hint="PNG, TIFF, JPEG, BMP, TGA and RAW files count as images",
        )


def read_image_list(path: Path) -> tuple[Path, ...]:
    """Return the images that a filenames.txt names, one on each line, relative to its folder.

    Raises:
        InputError: with the line, for an image that does not exist or is named twice; also for an empty list.
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
