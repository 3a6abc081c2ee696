"""Captures with ground truth as entries of a pixel set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splinecli.capture import capture_name, open_capture
from splinecli.capture.stamp import digest
from splinecli.capture.stored import name_reading
from splinecli.errors import InputError, OutputError
from splinecli.pixel_sets.store import Pixels
from splinecli.pixel_sets.writer import PixelSetWriter
from splinecli.system.files import free_name

if TYPE_CHECKING:
    from splinecli.capture import Capture, CaptureSource


class CaptureChangedError(OutputError):
    """A capture differs from the one that its entry was made from."""


def name_captures(folders: Sequence[Path], writer: PixelSetWriter) -> dict[str, Path]:
    """Choose the name of the entry of each capture, and return the folders by name.

    A capture that is in the set keeps its name. A new capture is named after its folder, with a number if another
    capture has that name. A folder that is given twice counts once, because its pixels must not both train and
    validate.
    """
    captures: dict[str, Path] = {}
    for resolved, folder in {folder.resolve(): folder for folder in folders}.items():

        def is_taken(name: str, source: str = str(resolved)) -> bool:
            by_another = name in writer and writer.recipe_of(name).get("source") != source
            return name in captures or by_another

        captures[free_name(capture_name(folder), is_taken)] = folder
    return captures


def add_capture(
    writer: PixelSetWriter,
    name: str,
    folder: Path,
    *,
    as_stored: bool = False,
    white_level: float | None = None,
    update: bool = False,
) -> None:
    """Read a capture and write its pixels with ground truth, unless the set has them.

    Of the images of CyclesPS's PRPS, only every second row and column counts: the training of CNN-PS reads them at
    half their size.

    Args:
        as_stored: use the stored values alone. By default, saturated observations are restored and unknown light
            intensities are estimated, as `infer` does.
        white_level: stored value from which a pixel counts as saturated; None to find it in the images.
        update: replace an entry whose capture changed.

    Raises:
        InputError: the capture cannot be read, or has no ground truth.
        CaptureChangedError: the capture changed since its entry was made, and `update` is not set.
        OutputError: the entry cannot be written.
    """
    source = open_capture(folder, white_level=white_level)
    recipe: dict[str, Any] = {
        "source": str(folder.resolve()),
        "reading": name_reading(as_stored=as_stored),
        "white_level": white_level,
        # The stamp depends on the white level too, so it is compared last.
        "files": digest(source.stamp),
    }
    if source.lamps is not None and source.lamps.used:
        raise InputError(
            "the capture has near lamps, and training needs distant lights",
            path=folder,
            hint="Leave it out, or render or photograph it under distant lights",
        )
    if name in writer:
        difference = writer.difference(name, recipe)
        if difference is None:
            return
        if not update:
            problem = f"its entry {name} was made with {difference}"
            if difference.startswith("files ="):
                problem = f"its files changed since the entry {name} was made"
            hint = "Add --update to read it again, or choose another -o"
            raise CaptureChangedError(problem, path=folder, hint=hint)
    if source.files.ground_truth is None:
        raise InputError("the capture has no ground truth, which training needs", path=folder)
    pixels = _pixels(source.read(as_stored=as_stored), source, folder)
    # The materials of an object of CyclesPS share its shape.
    scene = source.files.folder.absolute().name if source.files.boundaries else name
    writer.add(name, scene, str(folder), recipe, pixels)


def _pixels(capture: Capture, source: CaptureSource, folder: Path) -> Pixels:
    """Return the pixels of a capture that have a true normal. Raises InputError if there are none."""
    assert capture.ground_truth is not None
    normals = capture.ground_truth[capture.mask]
    # The images of CyclesPS's PRPS count at half their size.
    step = 2 if source.files.boundaries and source.files.folder.absolute().parent.name == "PRPS" else 1
    rows, columns = np.nonzero(capture.mask)
    used = normals.any(axis=1) & (rows % step == 0) & (columns % step == 0)
    if not used.any():
        raise InputError("no pixel of the mask has a ground-truth normal", path=folder)
    mask = np.zeros_like(capture.mask)
    mask[capture.mask] = used
    return Pixels(
        observations=capture.observations[used],
        normals=normals[used].astype(np.float32),
        light_directions=capture.light_directions.astype(np.float32),
        mask=mask[::step, ::step],
    )
