"""Find the files of a capture in a folder, and the captures of a dataset: the layouts are tried in turn."""

import re
from collections.abc import Sequence
from pathlib import Path

from splinecli.capture.formats.film import is_film
from splinecli.capture.layouts.capture_files import (
    FILENAMES,
    GROUND_TRUTH,
    LIGHT_FILES,
    LIGHT_INTENSITIES,
    MASK,
    NO_OVERRIDES,
    NOT_PHOTOGRAPHS,
    CaptureFiles,
    NoImagesError,
    Overrides,
    check_not_empty,
    find_images,
    find_lights,
    find_named,
    folder_name,
    list_folder,
    list_images,
)
from splinecli.capture.layouts.cyclesps import TREES, cyclesps_name, find_cyclesps, list_cyclesps
from splinecli.errors import InputError
from splinecli.system.files import StrPath, is_folder

_WORD = re.compile(r"[a-z]+")
_OTHER_WORDS = frozenset({"mask", "normal", "normals", "albedo", "ambient", "all", "depth"})
"""Words in the names of pictures that other programs leave beside the photographs."""

_MOST_OTHERS = 0.25  # share of the images up to which names with these words are not those of the photographs


PSBOX_LIGHTS, PSBOX_IMAGES = ("light_directions.txt",), "Objects"
"""The names of the light file and of the folder of images, in the layout of PSBox (Y. Xiong)."""


def find_capture_files(folder: StrPath, overrides: Overrides = NO_OVERRIDES) -> CaptureFiles:
    """Return the files of the capture in the folder. The overrides replace those in the folder.

    Raises InputError where the folder is missing, is a file or contains no images; filenames.txt names an image that
    does not exist; there is no light file; or a file of the overrides does not exist.
    """
    folder = Path(folder)
    list_folder(folder)  # raises where it is no folder
    overrides.named()
    try:
        # The plain folder comes last, because it takes any folder with images.
        return _find_psbox(folder, overrides) or find_cyclesps(folder, overrides) or _find_plain(folder, overrides)
    except NoImagesError as error:
        captures = [capture for path in _subfolders(folder) for capture in _captures_below(path)]
        if error.path != folder or not captures:
            raise
        hint = f"There are captures in {folder}, such as {captures[0]}: give these"
        raise InputError(error.problem, path=folder, hint=hint) from None


def capture_name(folder: StrPath) -> str:
    """Return the capture's name: that of the folder or the film; in CyclesPS <object>_<kind>. Raises InputError."""
    folder = Path(folder)
    return folder.stem if is_film(folder) else cyclesps_name(folder) or folder_name(folder)


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
    problem = f"found no capture, expected folders of images with a light file ({LIGHT_FILES})"
    hint = f"There are captures in {deeper[0]}: give that folder" if deeper else None
    raise InputError(problem, path=folder, hint=hint)


def _subfolders(folder: Path) -> list[Path]:
    return [entry for entry in list_folder(folder) if is_folder(entry)]


def _captures_in(folder: Path) -> list[Path]:
    """Return the folder if it is a capture, or the captures of a CyclesPS object."""
    if find_lights(folder) is not None:
        objects = folder / PSBOX_IMAGES
        is_psbox = is_folder(objects) and find_named(folder, PSBOX_LIGHTS) is not None
        if find_named(folder, [FILENAMES]) is not None or list_images(
            objects if is_psbox else folder, leave_out_stems=NOT_PHOTOGRAPHS
        ):
            return [folder]
    return list_cyclesps(folder) or []


def _captures_below(folder: Path) -> list[Path]:
    """Return the captures in the folder, and in its subfolders if it is a part of CyclesPS's tree."""
    try:
        if folder.name in TREES:
            return [capture for path in _subfolders(folder) for capture in _captures_in(path)]
        return _captures_in(folder)
    except InputError:
        return [folder]


def _find_plain(folder: Path, overrides: Overrides) -> CaptureFiles:
    """Return the capture's files. Raises InputError where there are no images or lights, or filenames.txt is wrong.

    A folder with filenames.txt and light_directions.txt has the layout of DiLiGenT (Shi et al.).
    """
    images, listed = find_images(folder, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=overrides.named())
    others = tuple(image for image in images if _OTHER_WORDS.intersection(_WORD.findall(image.stem.lower())))
    if listed or len(others) > _MOST_OTHERS * len(images):
        others = ()
    images = tuple(image for image in images if image not in others)
    lights = overrides.lights or (find_lights(folder) if overrides.needs_lights else None)
    if lights is None and overrides.needs_lights:
        raise InputError(
            f"the folder contains {len(images)} images but no light file ({LIGHT_FILES})",
            path=folder,
            hint="Pass --lights FILE, with one line x y z for each image. 'splinecli calibrate' makes the file from"
            " images of a mirror ball. Without one, --lights estimate finds the lights from the images, less exactly",
        )
    layout, ground_truth = "plain folder", GROUND_TRUTH
    if listed and find_named(folder, ["light_directions.txt"]) is not None:
        # normal.txt comes last: the one of harvestPNG is upside down, and its .mat is right.
        layout, ground_truth = "DiLiGenT", (*GROUND_TRUTH, "normal.txt")
    return _gather(layout, folder, images, lights, overrides, ground_truth, others)


def _find_psbox(folder: Path, overrides: Overrides) -> CaptureFiles | None:
    """Return the files of a capture of PSBox, whose images are in a folder of their own; None for another layout."""
    lights = overrides.lights or find_named(folder, PSBOX_LIGHTS)
    objects = folder / PSBOX_IMAGES
    if lights is None or not is_folder(objects):
        return None
    images = list_images(objects, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=overrides.named())
    check_not_empty(images, objects)
    return _gather("PSBox", folder, images, lights, overrides)


def _gather(
    layout: str,
    folder: Path,
    images: tuple[Path, ...],
    lights: Path | None,
    overrides: Overrides,
    ground_truth: Sequence[str] = GROUND_TRUTH,
    others: tuple[Path, ...] = (),
) -> CaptureFiles:
    """Return the capture's files: the images, the lights, and what else the folder has.

    Files that the user names come before those of the folder.
    """
    return CaptureFiles(
        layout,
        folder_name(folder),
        folder,
        images,
        light_directions=lights if overrides.needs_lights else None,
        light_intensities=overrides.intensities or find_named(folder, LIGHT_INTENSITIES),
        mask=overrides.mask or find_named(folder, MASK),
        ground_truth=overrides.ground_truth or find_named(folder, ground_truth),
        others=others,
    )
