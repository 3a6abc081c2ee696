"""Captures that arrive in a folder one after the other, each when it is complete."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from splinecli.capture.files import natural_key
from splinecli.capture.formats.film import is_film
from splinecli.errors import InputError

Stamp = tuple[int, int, int]  # number of files, their bytes, and the newest time of a change in nanoseconds


@dataclass
class _Seen:
    """What a folder held, since when it has not changed, and whether it was returned like this."""

    stamp: Stamp
    since: float
    returned: bool = False


class Arrivals:
    """The captures in a folder, its subfolders and films, that are complete and were not returned before.

    A capture is complete when it contains a file named `marker`, or, without a marker, and for a film, when nothing in
    it has changed for `seconds`. Names that begin with a dot are left out, and `without`, such as the folder of the
    results, which is no capture and lies in none. One that changes after it was returned is returned again. `clock`
    never goes back.
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

        Of two whose results have one name, such as a folder and a film, the second comes with the next call. Raises
        InputError if the folder cannot be read; later, all captures in it are returned again.
        """
        found = {path: _stamp(path) for path in self._captures()}
        self._seen = {path: seen for path, seen in self._seen.items() if path in found}
        ready: dict[str, Path] = {}
        for path, stamp in found.items():
            seen = self._seen.get(path)
            if seen is None or seen.stamp != stamp:
                seen = self._seen[path] = _Seen(stamp, self._clock())
            if not stamp[0] or seen.returned:
                continue
            unchanged = self._clock() - seen.since >= self.seconds
            by_time = self.marker is None or is_film(path)
            complete = unchanged if by_time else os.path.exists(path / str(self.marker))  # noqa: PTH110 - never raises
            name = path.stem if is_film(path) else path.name
            seen.returned = complete and ready.setdefault(name, path) is path
        return sorted(ready.values(), key=natural_key)

    def _captures(self) -> list[Path]:
        try:
            with os.scandir(self.folder) as entries:
                visible = [(entry.is_dir(), Path(entry.path)) for entry in entries if entry.name[0] != "."]
        except OSError as error:
            self._seen.clear()  # a capture that was being read has failed, and is to be tried again
            raise InputError(f"the folder cannot be read ({error.strerror})", path=self.folder) from error
        paths = [path for is_dir, path in visible if is_dir or is_film(path)]
        return [path for path in paths if path.resolve() not in self._left_out]


def _stamp(capture: Path) -> Stamp:
    """Return the stamp of a film, or of all files below a folder. Those that vanish meanwhile do not count."""
    count = size = newest = 0
    film = ("", (), [os.fspath(capture)])
    for place, _, names in [film] if is_film(capture) else os.walk(capture):
        for name in names:
            try:
                status = os.stat(os.path.join(place, name))  # noqa: PTH116, PTH118 - thousands of files a second
            except OSError:
                continue
            count, size, newest = count + 1, size + status.st_size, max(newest, status.st_mtime_ns, status.st_ctime_ns)
    return count, size, newest
