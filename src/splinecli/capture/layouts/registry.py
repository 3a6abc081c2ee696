"""Find the files of a capture in a folder, and the captures of a dataset: the layouts are tried in turn."""

from __future__ import annotations

from pathlib import Path

from splinecli.capture.formats.film import is_film
from splinecli.capture.layouts import cyclesps, plain_folder
from splinecli.capture.layouts.capture_files import (
    FILENAMES,
    LIGHT_FILES,
    NO_OVERRIDES,
    NOT_PHOTOGRAPHS,
    CaptureFiles,
    NoImagesError,
    Overrides,
    find_lights,
    find_named,
    folder_name,
    list_folder,
    list_images,
)
from splinecli.capture.paths import StrPath, is_folder
from splinecli.errors import InputError


def find_capture_files(folder: StrPath, overrides: Overrides = NO_OVERRIDES) -> CaptureFiles:
    """Return the files of the capture in the folder. The overrides replace those in the folder.

    Raises:
        InputError: the folder is missing, is a file or contains no images; filenames.txt names an image that
            does not exist; there is no light file; or a file of the overrides does not exist.
    """
    folder = Path(folder)
    list_folder(folder)  # raises where it is no folder
    overrides.named()
    try:
        # The plain folder comes last, because it takes any folder with images.
        finds = (plain_folder.find_psbox, cyclesps.find, plain_folder.find)
        return next(files for find in finds if (files := find(folder, overrides)) is not None)
    except NoImagesError as error:
        captures = [capture for path in _subfolders(folder) for capture in _captures_below(path)]
        if error.path != folder or not captures:
            raise
        hint = f"There are captures in {folder}, such as {captures[0]}: give these"
        raise InputError(error.problem, path=folder, hint=hint) from None


def capture_name(folder: StrPath) -> str:
    """Return the name of the capture: that of the folder or the film, but in CyclesPS <object>_<kind>.

    Raises:
        InputError: the system refuses to say what is there.
    """
    folder = Path(folder)
    return folder.stem if is_film(folder) else cyclesps.capture_name(folder) or folder_name(folder)


def find_captures(folder: StrPath) -> list[Path]:
    """Return the captures of a dataset's folder in natural order; the folder alone where it is a capture itself.

    A capture is a folder with a light file beside its images, or beside the folder Objects that contains them (PSBox),
    or a folder of images of a CyclesPS object. An object of CyclesPS and its published tree are datasets, too. The
    captures are found by names of files; reading one may still fail. A subfolder that cannot be listed counts as a
    capture, so that the caller reports it when it reads it.

    Raises:
        InputError: the folder is missing, is a file, or contains no capture.
    """
    folder = Path(folder)
    inside = _subfolders(folder)
    captures = _captures_in(folder) or [capture for path in inside for capture in _captures_below(path)]
    if captures:
        return captures
    deeper = [path for path in inside if any(_captures_below(sub) for sub in _subfolders(path))]
    raise InputError(
        f"found no capture, expected folders of images with a light file ({LIGHT_FILES})",
        path=folder,
        hint=f"There are captures in {deeper[0]}: give that folder" if deeper else None,
    )


def _subfolders(folder: Path) -> list[Path]:
    return [entry for entry in list_folder(folder) if is_folder(entry)]


def _captures_in(folder: Path) -> list[Path]:
    """Return the folder if it is a capture, or the captures of a CyclesPS object."""
    if find_lights(folder) is not None:
        objects = folder / plain_folder.PSBOX_IMAGES
        is_psbox = is_folder(objects) and find_named(folder, plain_folder.PSBOX_LIGHTS) is not None
        if find_named(folder, [FILENAMES]) is not None or list_images(
            objects if is_psbox else folder, leave_out_stems=NOT_PHOTOGRAPHS
        ):
            return [folder]
    return cyclesps.list_captures(folder) or []


def _captures_below(folder: Path) -> list[Path]:
    """Return the captures in the folder, and in its subfolders if it is a part of CyclesPS's tree."""
    try:
        if folder.name in cyclesps.TREES:
            return [capture for path in _subfolders(folder) for capture in _captures_in(path)]
        return _captures_in(folder)
    except InputError:
        return [folder]
