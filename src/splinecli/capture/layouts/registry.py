"""From a folder to the files of a capture: the one place where the layouts are tried in turn."""

from __future__ import annotations

from pathlib import Path

from splinecli.capture.layouts import cyclesps, plain_folder, psbox
from splinecli.capture.layouts.capture_files import (
    FILENAMES,
    LIGHT_FILES,
    NOT_PHOTOGRAPHS,
    CaptureFiles,
    Overrides,
    find_lights,
    find_named,
    folder_name,
)
from splinecli.capture.layouts.image_lists import list_folder, list_images
from splinecli.capture.paths import StrPath, is_folder
from splinecli.errors import InputError

# Special before general: a plain folder takes whatever holds images.
_LAYOUTS = (psbox.find, cyclesps.find, plain_folder.find)


def find_capture_files(
    folder: StrPath,
    *,
    lights: StrPath | None = None,
    intensities: StrPath | None = None,
    mask: StrPath | None = None,
    ground_truth: StrPath | None = None,
) -> CaptureFiles:
    """The files of the capture in the folder; files named here go before those that the folder holds.

    Raises:
        InputError: the folder is missing, is a file or holds no images; filenames.txt names an image that
            does not exist; there is no light file; or a file named here does not exist.
    """
    named = (lights, intensities, mask, ground_truth)
    overrides = Overrides(*(None if file is None else Path(file) for file in named))
    list_folder(Path(folder))  # raises where it is no folder
    overrides.named()
    for find in _LAYOUTS:
        files = find(Path(folder), overrides)
        if files is not None:
            return files
    raise AssertionError("the plain folder takes every folder or raises")  # pragma: no cover


def capture_name(folder: StrPath) -> str:
    """What the capture in the folder is called: like the folder, but in CyclesPS <object>_<kind>.

    Raises:
        InputError: the system does not tell what lies there.
    """
    return cyclesps.capture_name(Path(folder)) or folder_name(Path(folder))


def find_captures(folder: StrPath) -> list[Path]:
    """The captures of a dataset's folder in natural order, or the folder alone where it is a capture itself.

    A capture is a folder with a light file beside its images, or beside the folder Objects that holds them
    (PSBox), or one of the folders of images that a CyclesPS object holds; of CyclesPS, an object and the
    published tree are datasets too. Whether a capture can be read shows when it is read.

    Raises:
        InputError: the folder is missing, is a file, or holds no capture.
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
    """The folder, where it is a capture, or the captures of the object that it is."""
    return [folder] if _looks_like_capture(folder) else cyclesps.list_captures(folder)


def _captures_below(folder: Path) -> list[Path]:
    """Those in the folder, and in its subfolders where it is a part of CyclesPS's tree."""
    if folder.name in cyclesps.TREES:
        return [capture for path in _subfolders(folder) for capture in _captures_in(path)]
    return _captures_in(folder)


def _looks_like_capture(folder: Path) -> bool:
    if find_lights(folder) is None:
        return False
    if find_named(folder, [FILENAMES]) is not None:
        return True
    objects = psbox.list_objects(folder)
    if objects is not None:
        return bool(objects)
    return bool(list_images(folder, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=()))
