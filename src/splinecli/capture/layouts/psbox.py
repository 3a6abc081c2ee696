"""The layout of PSBox (Y. Xiong): the object's images in Objects/, and the light file beside that folder."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from splinecli.capture.layouts.capture_files import (
    NOT_PHOTOGRAPHS,
    CaptureFiles,
    Overrides,
    find_named,
    gather_files,
)
from splinecli.capture.layouts.image_lists import check_not_empty, list_images
from splinecli.capture.paths import is_folder

_LIGHT_DIRECTIONS = ("light_directions.txt",)
_OBJECTS = "Objects"


def find(folder: Path, overrides: Overrides) -> CaptureFiles | None:
    """Return the capture's files, or None for another layout. Raises InputError if Objects/ contains no images."""
    lights = overrides.lights or find_named(folder, _LIGHT_DIRECTIONS)
    images = list_objects(folder, leave_out=overrides.named(), lights=lights)
    if lights is None or images is None:
        return None
    check_not_empty(images, folder / _OBJECTS)
    return gather_files("PSBox", folder, images, lights, overrides)


def list_objects(
    folder: Path, *, leave_out: Collection[Path] = (), lights: Path | None = None
) -> tuple[Path, ...] | None:
    """Return the images of Objects/; None for another layout.

    Args:
        leave_out: files that have another meaning.
        lights: a light file named by the user; without it, the folder must contain one.
    """
    objects = folder / _OBJECTS
    if (lights or find_named(folder, _LIGHT_DIRECTIONS)) is None or not is_folder(objects):
        return None
    return list_images(objects, leave_out_stems=NOT_PHOTOGRAPHS, leave_out=leave_out)
