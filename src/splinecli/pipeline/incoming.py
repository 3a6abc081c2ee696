"""Detect complete captures, which are folders of images or videos, and extract the frames of
videos.
"""

import json
import os
import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from msgspec import Struct, to_builtins

from splinecli.capture import capture_name
from splinecli.capture.files import digest, natural_key, stamp_content
from splinecli.capture.formats.film import FEWEST_FRAMES, choose_frames, is_film, read_frames
from splinecli.errors import InputError, OutputError, UsageError
from splinecli.pictures.maps import encode_png
from splinecli.pipeline.infer_options import ReadingOptions, Redo
from splinecli.system.files import is_folder, read_json
from splinecli.system.progress import Observer
from splinecli.system.publishing import held_folder, is_plain, new_files, refuse_link

# Folder in the output folder of `infer` that contains a folder of frames for each video
FOLDER = "frames"
_RECORD = "film.json"
_FRAME = re.compile(r"frame-\d{6,}\.png")


def unpacked(
    capture: Path, output: Path, reading: ReadingOptions, observer: Observer, *, redo: Redo
) -> Path:
    """Return the capture or, for a video, the folder in `output` with its frames.

    The frames are extracted if needed. `redo` decides whether existing frames are kept, replaced if
    they come from another video, or extracted again. Raises UsageError if an option refers to a
    light file, InputError if the video cannot be read or its light does not move, and OutputError
    if the folder contains frames of another video or other files, or if the frames cannot be
    written.
    """
    if not is_film(capture):
        return capture
    if not (reading.finds_lights or reading.may_find_lights):
        raise UsageError(
            f"{capture} is a video, so its lights must be estimated",
            hint="Leave out options that refer to given lights",
        )
    folder, stamp = output / FOLDER / capture.stem, digest([stamp_content(capture)])
    refuse_link(folder.parent)
    refuse_link(folder)
    with held_folder(folder, observer.warn):
        earlier = _earlier(folder)
        of_film, sizes = earlier.sha256, earlier.frames
        # Other files would be mistaken for photographs or for a mask.
        known = {*sizes, _RECORD}
        others = sorted(
            e.name for e in folder.iterdir() if e.name not in known and not e.name.startswith(".")
        )
        if others and (sizes or not all(map(_FRAME.fullmatch, others))):
            raise OutputError(
                f"the folder contains {others[0]}, which is not a frame of this video",
                path=folder,
                hint="Move the file, or choose another folder with -o",
            )
        whole = all(
            is_plain(folder / name) and (folder / name).stat().st_size == sizes[name]
            for name in sizes
        )
        if of_film == stamp and whole and redo != "all":
            return folder
        if of_film not in (stamp, "") and redo == "nothing":
            raise OutputError(
                "the folder contains frames of another video, or of an earlier version of this one",
                path=folder,
                hint="Add --update to extract the frames of this video, or choose another folder"
                " with -o",
            )
        with observer.progress(f"{capture.stem}: choosing frames", 1) as advance:
            numbers = choose_frames(capture)
            advance(1)
        names = [f"frame-{number:06}.png" for number in numbers]
        with new_files(folder, report=_RECORD, stale=sizes) as new:
            for name, frame in zip(names, read_frames(capture, numbers), strict=True):
                new.write(name, encode_png(frame, film=True))
            record = _Film(str(capture), stamp, new.sizes)
            new.write(_RECORD, json.dumps(to_builtins(record), indent=2) + "\n")
    return folder


class _Film(Struct):
    """The video of a folder of frames, and the sizes of the frames."""

    film: str
    sha256: str
    frames: dict[str, int]


def _earlier(folder: Path) -> _Film:
    """Return the record of the video whose frames are in the folder; an empty record if there are
    none.
    """
    with suppress(OSError, ValueError):
        record: _Film = read_json(folder / _RECORD, _Film)
        if len(record.frames) >= FEWEST_FRAMES and all(map(_FRAME.fullmatch, record.frames)):
            return record
    return _Film("", "", {})


# number of files, their total size in bytes, and the time of the last change in nanoseconds
Stamp = tuple[int, int, int]
# Interval between checks of all files of a capture that was already returned. In between, only its
# folders are checked. Their times change when a file is added, removed or replaced, but not when it
# is overwritten in place.
SECONDS_BETWEEN_FILES = 60.0


@dataclass
class _Seen:
    """The contents of a capture, when they last changed, and whether the capture was returned."""

    stamp: Stamp
    since: float
    # modification times of its folders, or of the video, in nanoseconds
    folders: dict[str, int]
    looked_at: float  # when the stamp was last compared with the files
    returned: bool = False


class Arrivals:
    """The complete captures in a folder (its subfolders and videos) that were not returned before.

    A capture is complete when it contains a file named `marker`. Videos, and all captures without a
    marker, are complete when they have not changed for `seconds`. Names that begin with a dot are
    ignored, and so is the folder `without`, such as the folder of the results, which must not be a
    capture or be inside one. A capture that changes after it was returned is returned again; a file
    that is overwritten in place is noticed within SECONDS_BETWEEN_FILES. `clock` is monotonic.
    """

    def __init__(
        self,
        folder: Path,
        *,
        marker: str | None,
        seconds: float,
        without: Path,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.folder, self.marker, self.seconds = folder, marker, seconds
        self._left_out = {without.resolve(), *without.resolve().parents}
        self._clock = clock
        self._seen: dict[Path, _Seen] = {}

    def take(self) -> list[Path]:
        """Return the captures that became complete since the last call, in natural order.

        If the results of two captures would have the same name, as for a folder and a video, the
        second is returned by the next call. Raises InputError if the folder cannot be read;
        afterwards, all its captures are returned again.
        """
        captures, now = self._captures(), self._clock()
        self._seen = {path: self._seen[path] for path in captures if path in self._seen}
        ready: dict[str, Path] = {}
        for path in captures:
            seen = self._seen.get(path)
            if (
                seen is not None
                and seen.returned
                and now - seen.looked_at < SECONDS_BETWEEN_FILES
                and all(_changed(place) == when for place, when in seen.folders.items())
            ):
                continue
            stamp, folders = _stamp(path)
            if seen is None or seen.stamp != stamp:
                seen = self._seen[path] = _Seen(stamp, now, folders, now)
            seen.folders, seen.looked_at = folders, now
            if not stamp[0] or seen.returned:
                continue
            unchanged = now - seen.since >= self.seconds
            by_time = self.marker is None or is_film(path)
            complete = unchanged if by_time else os.path.exists(path / str(self.marker))  # noqa: PTH110 - never raises
            name = path.name
            with suppress(InputError):  # reading the capture raises it again
                name = capture_name(path)
            seen.returned = complete and ready.setdefault(name, path) is path
        return sorted(ready.values(), key=natural_key)

    def _captures(self) -> list[Path]:
        try:
            with os.scandir(self.folder) as entries:
                visible = [Path(entry.path) for entry in entries if entry.name[0] != "."]
        except OSError as error:
            self._seen.clear()  # a capture that was being read failed and must be retried
            raise InputError(
                f"the folder cannot be read ({error.strerror})", path=self.folder
            ) from error
        paths = [path for path in visible if is_folder(path) or is_film(path)]
        # Path.resolve raises for a link to itself.
        return [path for path in paths if Path(os.path.realpath(path)) not in self._left_out]


def _changed(folder: str) -> int:
    with suppress(OSError):
        return os.stat(folder).st_mtime_ns  # noqa: PTH116 - see _stamp
    return -1


def _stamp(capture: Path) -> tuple[Stamp, dict[str, int]]:
    """Return the stamp of a video or of all files below a folder, and the folders; see _Seen.

    Files that disappear in the meantime are ignored.
    """
    count = size = newest = 0
    folders = {}
    film = ("", (), [os.fspath(capture)])
    for place, _, names in [film] if is_film(capture) else os.walk(capture):
        folders[place or os.fspath(capture)] = _changed(place or os.fspath(capture))
        for name in names:
            try:
                status = os.stat(os.path.join(place, name))  # noqa: PTH116, PTH118 - thousands of files a second
            except OSError:
                continue
            count, size = count + 1, size + status.st_size
            newest = max(newest, status.st_mtime_ns, status.st_ctime_ns)
    return (count, size, newest), folders
