"""The layout of PSBox (Y. Xiong): the object's images in Objects/, and the light file beside that folder."""

from __future__ import annotations

from pathlib import Path

from splinecli.capture.layouts.capture_files import NOT_PHOTOGRAPHS, CaptureFiles, Overrides, find_named, gather_files
from splinecli.capture.layouts.image_lists import check_not_empty, list_images
from splinecli.capture.paths import is_folder

LIGHT_DIRECTIONS, OBJECTS = ("light_directions.txt",), "Objects"
"""The names of the light file and of the folder of images."""


def find(folder: Path, overrides: Overrides) -> CaptureFiles | None:
    """Return the capture's files, or None for another layout. Raises InputError if Objects/ contains no images."""
    lights = overrides.lights or find_named(folder, LIGHT_DIRECTIONS)
    objects = folder / OBJECTS
    if lights is None or not is_folder(objects):
        return None
    images = list_images(objects, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=overrides.named())
    check_not_empty(images, objects)
    return gather_files("PSBox", folder, images, lights, overrides)
