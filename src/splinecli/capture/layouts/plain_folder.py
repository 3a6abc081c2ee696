"""The simplest layout: a folder of photographs, with a light file in it or named by the user."""

from __future__ import annotations

from pathlib import Path

from splinecli.capture.layouts.capture_files import (
    FILENAMES,
    GROUND_TRUTH,
    LIGHT_FILES,
    LIGHT_INTENSITIES,
    MASK,
    NOT_PHOTOGRAPHS,
    CaptureFiles,
    Overrides,
    find_lights,
    find_named,
    folder_name,
)
from splinecli.capture.layouts.image_lists import check_not_empty, list_images, read_image_list
from splinecli.errors import InputError


def find(folder: Path, overrides: Overrides) -> CaptureFiles:
    """The capture's files: the images in natural order, or in that of filenames.txt where there is one.

    Raises:
        InputError: the folder holds no images, or no light file and none is named.
    """
    filenames = find_named(folder, [FILENAMES])
    if filenames is not None:
        images = read_image_list(filenames)
    else:
        images = list_images(folder, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=overrides.named())
    check_not_empty(images, folder)
    lights = overrides.lights or find_lights(folder)
    if lights is None:
        raise InputError(
            f"the folder holds {len(images)} images but no light file ({LIGHT_FILES})",
            path=folder,
            hint="Pass --lights FILE, with one line x y z for each image; photographs of a mirror ball tell it to"
            " 'splinecli calibrate'",
        )
    return CaptureFiles(
        layout="plain folder",
        name=folder_name(folder),
        folder=folder,
        images=images,
        light_directions=lights,
        light_intensities=overrides.intensities or find_named(folder, LIGHT_INTENSITIES),
        mask=overrides.mask or find_named(folder, MASK),
        ground_truth=overrides.ground_truth or find_named(folder, GROUND_TRUTH),
    )
