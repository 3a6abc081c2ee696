"""The layout of PSBox (Y. Xiong): the object's images in Objects/, the light file beside that folder."""

from __future__ import annotations

from pathlib import Path

from splinecli.capture.capture_files import (
    GROUND_TRUTH,
    LIGHT_INTENSITIES,
    MASK,
    CaptureFiles,
    Overrides,
    capture_name,
    find_named,
)
from splinecli.capture.image_lists import list_images


def find(folder: Path, overrides: Overrides) -> CaptureFiles | None:
    """The capture's files, or None for another layout."""
    lights = find_named(folder, ["light_directions.txt"])
    objects = folder / "Objects"
    if lights is None or not objects.is_dir():
        return None
    return CaptureFiles(
        name=capture_name(folder),
        folder=folder,
        images=list_images(objects, leave_out_stems=(), leave_out=overrides.named()),
        light_directions=overrides.lights or lights,
        light_intensities=overrides.intensities or find_named(folder, LIGHT_INTENSITIES),
        mask=overrides.mask or find_named(folder, MASK),
        ground_truth=overrides.ground_truth or find_named(folder, GROUND_TRUTH),
    )
