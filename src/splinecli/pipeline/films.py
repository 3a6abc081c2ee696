"""Unpack a film into a folder of images, which is then read like any capture."""

import json
import re
from pathlib import Path
from typing import Literal

from splinecli.capture.files import digest, stamp_content
from splinecli.capture.formats.film import FEWEST_FRAMES, choose_frames, is_film, read_frames
from splinecli.errors import OutputError, UsageError
from splinecli.pictures.png import encode_png
from splinecli.pipeline.infer_options import Reading
from splinecli.system.files import read_json
from splinecli.system.progress import Observer
from splinecli.system.publishing import held_folder, is_plain, new_files, refuse_link

FOLDER = "frames"  # the folder in the output folder of `infer` with a folder of frames for each film
_RECORD = "film.json"
_FRAME = re.compile(r"frame-\d{6,}\.png")


def unpacked(
    capture: Path, output: Path, reading: Reading, observer: Observer, *, redo: Literal["nothing", "changed", "all"]
) -> Path:
    """Return the capture; of a film, the folder of its frames in `output`, which are taken now or were earlier.

    Args:
        redo: whether frames of an earlier film are kept, replaced by those of another film, or taken again.

    Raises:
        UsageError: the lights of a film are not to be found from its images.
        InputError: the film cannot be read, or its light does not move.
        OutputError: the folder has frames of another film, or other files, or the frames cannot be written.
    """
    if not is_film(capture):
        return capture
    if not reading.finds_lights:
        raise UsageError(f"{capture} is a film, whose lights have to be found", hint="Add --lights estimate")
    folder, stamp = output / FOLDER / capture.stem, digest([stamp_content(capture)])
    refuse_link(folder.parent)
    refuse_link(folder)
    with held_folder(folder, observer.warn):
        of_film, sizes = _earlier(folder)
        # Other files would count as photographs, or as a mask.
        known = {*sizes, _RECORD}
        others = sorted(e.name for e in folder.iterdir() if e.name not in known and not e.name.startswith("."))
        if others and (sizes or not all(map(_FRAME.fullmatch, others))):
            raise OutputError(
                f"contains {others[0]}, which is no frame of this film",
                path=folder,
                hint="Move it, or choose another -o",
            )
        whole = all(is_plain(folder / name) and (folder / name).stat().st_size == sizes[name] for name in sizes)
        if of_film == stamp and whole and redo != "all":
            return folder
        if of_film not in (stamp, "") and redo == "nothing":
            raise OutputError(
                "contains the frames of another film, or of an earlier version of this one",
                path=folder,
                hint="Add --update to take those of this film, or choose another place with -o",
            )
        with observer.progress(f"{capture.stem}: choosing frames", 1) as advance:
            numbers = choose_frames(capture)
            advance(1)
        names = [f"frame-{number:06}.png" for number in numbers]
        with new_files(folder, report=_RECORD, stale=sizes) as new:
            for name, frame in zip(names, read_frames(capture, numbers), strict=True):
                new.write(name, encode_png(frame, film=True))
            record = {"film": str(capture), "sha256": stamp, "frames": new.sizes}
            new.write(_RECORD, json.dumps(record, indent=2) + "\n")
    return folder


def _earlier(folder: Path) -> tuple[str, dict[str, int]]:
    """Return the stamp of the film whose frames are in the folder, and their sizes; nothing for none."""
    try:
        record = read_json(folder / _RECORD)
        frames = {str(name): int(size) for name, size in record["frames"].items()}
        if len(frames) >= FEWEST_FRAMES and all(map(_FRAME.fullmatch, frames)):
            return str(record["sha256"]), frames
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass
    return "", {}
