"""The layout of the DiLiGenT benchmark (Shi et al.): filenames.txt and light_directions.txt by the images."""

from __future__ import annotations

from pathlib import Path

from splinecli.capture.layouts.capture_files import (
    FILENAMES,
    GROUND_TRUTH,
    LIGHT_INTENSITIES,
    MASK,
    CaptureFiles,
    Overrides,
    find_named,
    folder_name,
)
from splinecli.capture.layouts.image_lists import read_image_list

# normal.txt comes last: that of harvestPNG is upside down, where the .mat is right.
_GROUND_TRUTH = (*GROUND_TRUTH, "normal.txt")


def find(folder: Path, overrides: Overrides) -> CaptureFiles | None:
    """The capture's files, or None for another layout; InputError for a bad filenames.txt."""
    filenames = find_named(folder, [FILENAMES])
    lights = find_named(folder, ["light_directions.txt"])
    if filenames is None or lights is None:
        return None
    return CaptureFiles(
        layout="DiLiGenT",
        name=folder_name(folder),
        folder=folder,
        images=read_image_list(filenames),
        light_directions=overrides.lights or lights,
        light_intensities=overrides.intensities or find_named(folder, LIGHT_INTENSITIES),
        mask=overrides.mask or find_named(folder, MASK),
        ground_truth=overrides.ground_truth or find_named(folder, _GROUND_TRUTH),
    )
