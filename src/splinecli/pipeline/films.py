"""Unpack a film into a folder of images, which is then read like any capture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from splinecli.capture.formats.film import choose_frames, is_film, read_frames
from splinecli.capture.stamp import digest, stamp_content
from splinecli.errors import UsageError
from splinecli.pictures.png import encode_png
from splinecli.pipeline.observer import Observer
from splinecli.pipeline.reading import Reading
from splinecli.system.files import read_json
from splinecli.system.publishing import held_folder, is_plain, new_files, refuse_link

FOLDER = "frames"
"""The folder in the output folder of `infer` with a folder of frames for each film."""

_RECORD = "film.json"


def unpacked(capture: Path, output: Path, reading: Reading, observer: Observer) -> Path:
    """Return the capture; of a film, the folder of its frames in `output`, which are taken now or were earlier.

    Raises:
        UsageError: the lights of a film are not to be found from its images.
        InputError: the film cannot be read, or its light does not move.
        OutputError: the frames cannot be written.
    """
    if not is_film(capture):
        return capture
    if not reading.finds_lights:
        raise UsageError(f"{capture} is a film, and no file has its lights", hint="Add --lights estimate")
    folder, stamp = output / FOLDER / capture.stem, digest([stamp_content(capture)])
    refuse_link(folder.parent)
    refuse_link(folder)
    with held_folder(folder, observer.warn):
        earlier = _earlier(folder)
        if earlier[0] == stamp and all(is_plain(folder / name) for name in earlier[1]):
            return folder
        with observer.progress(f"{capture.stem}: choosing frames", 1) as advance:
            numbers = choose_frames(capture)
            advance(1)
        names = [f"frame-{number:06}.png" for number in numbers]
        with new_files(folder, report=_RECORD, stale=earlier[1]) as new:
            for name, frame in zip(names, read_frames(capture, numbers), strict=True):
                new.write(name, encode_png(frame, film=True))
            new.write(_RECORD, json.dumps({"film": str(capture), "sha256": stamp, "frames": names}, indent=2))
    return folder


def _earlier(folder: Path) -> tuple[str, Sequence[str]]:
    """Return the stamp of the film and the names of the frames that are in the folder; nothing for none."""
    try:
        record = read_json(folder / _RECORD)
        names = [name for name in record["frames"] if name.startswith("frame-") and Path(name).name == name]
        return str(record["sha256"]), names
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "", ()
