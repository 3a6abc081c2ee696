"""Captures that arrive in a folder one after the other, each when it is complete."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from splinecli.capture.layouts.capture_files import natural_key
from splinecli.errors import InputError

Stamp = tuple[int, int, int]  # number of files, their bytes, and the newest time of a change in nanoseconds


@dataclass
class _Seen:
    """What a folder held, since when it has not changed, and whether it was returned like this."""

    stamp: Stamp
    since: float
    returned: bool = False


class Arrivals:
    """The captures in a folder, its subfolders, that are complete and were not returned before.

    A capture is complete when it contains a file named `marker`, or, without a marker, when nothing in it has changed
    for `seconds`. Folders whose names begin with a dot are left out, and `without`, such as the folder of the results,
    which is no capture and lies in none. One that changes after it was returned is returned again. `clock` never goes
    back.
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
        """Return the captures that became complete since the last call, in natural order of their names.

        Raises InputError if the folder cannot be read.
        """
        found = {path: _stamp(path) for path in self._subfolders()}
        self._seen = {path: seen for path, seen in self._seen.items() if path in found}
        ready = []
        for path, stamp in found.items():
            seen = self._seen.get(path)
            if seen is None or seen.stamp != stamp:
                seen = self._seen[path] = _Seen(stamp, self._clock())
            if not stamp[0] or seen.returned:
                continue
            unchanged = self._clock() - seen.since >= self.seconds
            seen.returned = unchanged if self.marker is None else (path / self.marker).exists()
            if seen.returned:
                ready.append(path)
        return sorted(ready, key=natural_key)

    def _subfolders(self) -> list[Path]:
        try:
            with os.scandir(self.folder) as entries:
                folders = [Path(entry.path) for entry in entries if entry.is_dir() and entry.name[0] != "."]
        except OSError as error:
            raise InputError(f"the folder cannot be read ({error.strerror})", path=self.folder) from error
        return [folder for folder in folders if folder.resolve() not in self._left_out]


def _stamp(folder: Path) -> Stamp:
    """Return the stamp of all files below a folder. Those that vanish meanwhile do not count."""
    count = size = newest = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                status = os.stat(os.path.join(place, name))  # noqa: PTH116, PTH118 - thousands of files a second
            except OSError:
                continue
            count, size, newest = count + 1, size + status.st_size, max(newest, status.st_mtime_ns, status.st_ctime_ns)
    return count, size, newest
