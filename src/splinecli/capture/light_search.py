"""Find the lights of a capture in light files with usual names, in nearby folders, and in image
names.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from itertools import chain, groupby
from pathlib import Path

import numpy as np

from splinecli.capture.files import (
    LIGHT_POSITIONS,
    find_named,
    folder_name,
    list_folder,
    list_images,
    short_list,
)
from splinecli.capture.formats import numbers
from splinecli.capture.formats.decoders import page_of
from splinecli.capture.light_files import FORMATS, match_images, read_lights
from splinecli.capture.light_rows import RowForm
from splinecli.capture.lights_in_names import lights_in_names
from splinecli.errors import InputError
from splinecli.maths import Float64Array
from splinecli.records.capture_warnings import LIGHTS_FOUND, CaptureWarning
from splinecli.system.files import is_folder, is_found_file

_SUFFIXES = {".txt", *(suffix for each in FORMATS for suffix in each.suffixes)}
_OTHER_FILES = re.compile("intens|camera|filenames|lobes|position|calibration|normal")
_LIGHTS = r"(.*[^a-z])?light(s|ing)?[^a-z]*(dirs?|directions?|vec(tor)?s?|sources?|matrix)?[^a-z]*"
_LIGHT_FOLDER = re.compile(rf"{_LIGHTS}|lamps?|leds?|lp")
_MOST_FILES = 50  # most files that are tried per folder


class NoLightsError(InputError):
    """No lights were found for a capture."""


def light_names() -> str:
    """Return the names by which light files are found, for messages."""
    names = [name for each in FORMATS for name in each.found]
    return f"{', '.join(names)} or {LIGHT_POSITIONS[0]}"


def find_light_file(folder: Path) -> Path | None:
    """Return the light file with a usual name in the folder, or None.

    Raises InputError if there are several files of the same rank above 0.
    """
    for rank, group in groupby(_usual(folder), lambda found: found[0]):
        paths = [path for _, path in group if is_found_file(path)]
        if rank and len(paths) > 1:
            raise InputError(
                f"found {len(paths)} light files: {', '.join(path.name for path in paths)}",
                folder,
                hint="Choose one with --lights FILE",
            )
        if paths:
            return paths[0]
    return find_named(folder, LIGHT_POSITIONS)


def _usual(folder: Path) -> Iterator[tuple[int, Path]]:
    """Yield the ranks and paths of entries with usual names of light files, in order of
    precedence.
    """
    entries = list_folder(folder)
    for rank in sorted({each.rank for each in FORMATS}):
        for name in (name for each in FORMATS if each.rank == rank for name in each.found):
            yield from ((rank, e) for e in entries if fnmatchcase(e.name.lower(), name.lower()))


def search_lights(
    folder: Path, images: Sequence[Path]
) -> tuple[Path | None, tuple[CaptureWarning, ...]]:
    """Return the source of lights for a capture without a usual light file, and a warning that
    names it.

    The folder, a folder called Lights inside it or next to it, and the parent folder are searched
    for a light file that fits the images. If the image names contain lights, their folder is
    returned. Return None if nothing is found. Raises InputError if several files fit but differ.
    """
    stored, of_images = page_of(images[0])[0], images[0].parent
    if stored.suffix.lower() == ".mat" and _fit(stored, images) is not None:
        return stored, ()
    for place in _places(folder, of_images):
        fits = {path: lights for path in place if (lights := _fit(path, images)) is not None}
        if not fits:
            continue
        path, *_ = fits
        if not all(np.array_equal(fits[path], other, equal_nan=True) for other in fits.values()):
            raise InputError(
                f"found {len(fits)} files that fit the images: {short_list([*fits])}",
                path.parent,
                hint="Choose one with --lights FILE",
            )
        return path, _found(path)
    for path in _candidates(folder):  # files of any name, if they name the images
        if _fit(path, images, named=True) is not None:
            return path, _found(path)
    if (named := lights_in_names(images)) is not None:
        return of_images, _found(f"the names of the images: {named[1]}")
    return None, ()


def _found(source: object) -> tuple[CaptureWarning, ...]:
    text = f"The light directions were read from {source}. To use other lights, pass --lights FILE."
    return (CaptureWarning(LIGHTS_FOUND, text),)


def _places(folder: Path, of_images: Path) -> Iterator[list[Path]]:
    """Yield the candidate light files of each place, starting with the nearest place."""
    near = dict.fromkeys((folder, of_images))
    yield [path for each in near for path in _likely(each)]
    above = folder.absolute().parent
    with suppress(InputError):  # the parent may be unreadable
        for around in dict.fromkeys((folder, of_images, above)):
            yield [path for each in light_folders(around) for path in _candidates(each)]
        name, entries = folder_name(folder).lower(), list_folder(above)
        others = {each.name.lower() for each in entries if is_folder(each)} - {name}
        own = [path for path in _candidates(above) if path.stem.lower() == name]
        yield own or [path for path in _likely(above) if path.stem.lower() not in others]


def light_folders(folder: Path) -> list[Path]:
    """Return the subfolders called Lights or similar that contain no images."""
    named = [each for each in list_folder(folder) if _LIGHT_FOLDER.fullmatch(each.name.lower())]
    return [each for each in named if is_folder(each) and not list_images(each)]


def has_lights(folder: Path) -> bool:
    """Return whether a folder contains files or folders whose names are typical of lights."""
    return bool(_likely(folder) or light_folders(folder))


def _likely(folder: Path) -> list[Path]:
    """Return the files in a folder whose names are typical of light files."""
    usual = {path for _, path in _usual(folder)}
    files = _candidates(folder)
    return [p for p in files if p in usual or re.fullmatch(_LIGHTS, p.stem.lower())]


def _candidates(folder: Path) -> list[Path]:
    """Return the files in a folder that have the suffix of a light file but no other role."""
    files = [
        path
        for path in list_folder(folder)
        if path.suffix.lower() in _SUFFIXES
        and not _OTHER_FILES.search(path.name.lower())
        and is_found_file(path)
    ]
    return sorted(files, key=lambda path: "light" not in path.name.lower())[:_MOST_FILES]


def _fit(
    path: Path,
    images: Sequence[Path],
    form: RowForm = "xyz",
    *,
    by_order: bool = False,
    named: bool = False,
) -> Float64Array | None:
    """Return the lights (F, 3) of a file in the order of the images, or None if they do not match.

    Images without a light get NaN.

    Args:
        by_order: whether the file may name other images.
        named: whether the file must name its images.
    """
    longest = min(numbers.MOST_TEXT, 20_000 + 500 * len(images))  # longer files take too long
    with suppress(InputError, OSError):
        if path.suffix.lower() != ".mat" and path.stat().st_size > longest:
            return None
        for count in (len(images), 3 * len(images)):  # each channel may have its own light
            with suppress(InputError):
                table, directions = read_lights(path, count, form=form)
                if table.names is None:
                    return None if named else directions
                chosen, how = match_images(table, images)
                if how == "order" and not by_order:
                    return None
                lights = np.full((len(images), 3), np.nan)
                lights[[images.index(image) for image in chosen]] = directions
                return lights
    return None


def light_option(folder: Path, images: Sequence[Path]) -> str | None:
    """Return the options for reading a file as lights, or None if no file fits.

    Any file in the folder or next to the images is tried; in other places, only files whose names
    are typical of lights. Raises InputError with the reason if such a file in the capture's folder
    does not fit.
    """
    near = dict.fromkeys((folder, images[0].parent))
    named, *others = _places(folder, images[0].parent)
    candidates = [path for each in near for path in _candidates(each)]
    for path in dict.fromkeys(chain(candidates, *others)):
        is_slant = re.search("slant|tilt", path.name.lower())
        angles: RowForm = "slant-tilt" if is_slant else "azel"
        for form in ("xyz", angles):
            if _fit(path, images, form, by_order=True) is not None:
                option = f"--lights {path}"
                return option if form == "xyz" else f"{option} --light-format {form}"
    inside = [path for each in near for of in light_folders(each) for path in _candidates(of)]
    for path in (*named, *inside):
        read_lights(path, len(images))
    return None
