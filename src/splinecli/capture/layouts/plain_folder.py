"""Folders of images with a light file, in it or named by the user: plain ones, DiLiGenT and PSBox."""

from __future__ import annotations

import re
from pathlib import Path

from splinecli.capture.layouts.capture_files import (
    FILENAMES,
    GROUND_TRUTH,
    LIGHT_FILES,
    NOT_PHOTOGRAPHS,
    CaptureFiles,
    Overrides,
    check_not_empty,
    find_lights,
    find_named,
    gather_files,
    list_images,
    read_image_list,
)
from splinecli.capture.paths import is_folder
from splinecli.errors import InputError

_WORD = re.compile(r"[a-z]+")
_OTHER_WORDS = frozenset({"mask", "normal", "normals", "albedo", "ambient", "all", "depth"})
"""Words in the names of pictures that other programs leave beside the photographs."""

_MOST_OTHERS = 0.25  # share of the images up to which names with these words are not those of the photographs


PSBOX_LIGHTS, PSBOX_IMAGES = ("light_directions.txt",), "Objects"
"""The names of the light file and of the folder of images, in the layout of PSBox (Y. Xiong)."""


def find(folder: Path, overrides: Overrides) -> CaptureFiles:
    """Return the capture's files, with the images in natural order or in the order of filenames.txt.

    A folder with filenames.txt and light_directions.txt has the layout of DiLiGenT (Shi et al.).

    Raises:
        InputError: the folder contains no images, filenames.txt is wrong, or there is no light file and none is named.
    """
    filenames = find_named(folder, [FILENAMES])
    if filenames is not None:
        images = read_image_list(filenames)
    else:
        images = list_images(folder, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=overrides.named())
    check_not_empty(images, folder)
    others = tuple(image for image in images if _OTHER_WORDS.intersection(_WORD.findall(image.stem.lower())))
    if filenames is not None or len(others) > _MOST_OTHERS * len(images):
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
    if filenames is not None and find_named(folder, ["light_directions.txt"]) is not None:
        # normal.txt comes last: the one of harvestPNG is upside down, and its .mat is right.
        layout, ground_truth = "DiLiGenT", (*GROUND_TRUTH, "normal.txt")
    return gather_files(layout, folder, images, lights, overrides, ground_truth_names=ground_truth, others=others)


def find_psbox(folder: Path, overrides: Overrides) -> CaptureFiles | None:
    """Return the files of a capture of PSBox, or None for another layout: its images are in a folder of their own.

    Raises:
        InputError: that folder contains no images.
    """
    lights = overrides.lights or find_named(folder, PSBOX_LIGHTS)
    objects = folder / PSBOX_IMAGES
    if lights is None or not is_folder(objects):
        return None
    images = list_images(objects, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=overrides.named())
    check_not_empty(images, objects)
    return gather_files("PSBox", folder, images, lights, overrides)
