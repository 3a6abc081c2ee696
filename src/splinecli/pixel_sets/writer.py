"""Writing of pixel sets, entry by entry, so that an interrupted command can continue."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splinecli import __version__
from splinecli.errors import OutputError
from splinecli.pixel_sets.store import ARRAYS, FORMAT, MANIFEST, Entry, Pixels, PixelSet, parse_entries, read_manifest
from splinecli.system.files import check_writable, file_sha256, write_text
from splinecli.system.publishing import LOCK, new_files


class PixelSetWriter:
    """Writes a new set, or adds entries to an existing one, finished or not.

    The manifest never names an entry whose files change: it is written without it before, and with it after.
    """

    def __init__(self, folder: Path) -> None:
        """Open the folder.

        Raises:
            OutputError: the folder cannot be written, or has other files in it.
            InputError: its manifest is damaged.
        """
        check_writable(folder)
        self.folder = folder
        self._entries: dict[str, Entry] = {}
        if (folder / MANIFEST).exists():
            self._entries = {entry.name: entry for entry in parse_entries(read_manifest(folder), folder)}
        elif folder.is_dir() and any(path.name != LOCK for path in folder.iterdir()):
            raise OutputError("has files in it but is not a pixel set", path=folder, hint="Choose another -o")
        else:
            self._write_manifest(complete=False)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    @property
    def pixel_set(self) -> PixelSet:
        """The set with its entries so far."""
        return PixelSet(self.folder, tuple(self._entries.values()))

    def recipe_of(self, name: str) -> dict[str, Any]:
        """Return the recipe of an entry of the set."""
        return self._entries[name].recipe

    def difference(self, name: str, recipe: dict[str, Any]) -> str | None:
        """Return in words the first setting in which an entry's recipe differs, with both values, or None."""
        asked, found = _plain(recipe), self._entries[name].recipe
        for key in [*asked, *found]:
            if asked.get(key) != found.get(key):
                return f"{key} = {found.get(key)!r}, not {asked.get(key)!r}"
        return None

    def describe(self, name: str) -> str:
        """Return a line for the user about an entry of the set."""
        entry = self._entries[name]
        return f"{name}: {entry.n_pixels} pixels, {entry.n_lights} lights, {entry.source}"

    def add(self, name: str, scene: str, source: str, recipe: dict[str, Any], pixels: Pixels) -> None:
        """Write an entry of at least one pixel, in place of an earlier entry of that name.

        Raises OutputError if it cannot be written. The other entries are then as they were before.
        """
        n_pixels, n_lights = pixels.observations.shape
        checksums = {}
        with new_files(self.folder, report=None) as new:
            for array in ARRAYS:
                file = f"{name}/{array}.npy"
                new.write(file, getattr(pixels, array))
                checksums[array] = file_sha256(new.hidden[file])
            if self._entries.pop(name, None) is not None:
                self._write_manifest(complete=False)
        self._entries[name] = Entry(name, scene, source, _plain(recipe), n_pixels, n_lights, checksums)
        self._write_manifest(complete=False)

    def finish(self) -> PixelSet:
        """Mark the set as finished and return it. Raises OutputError."""
        self._write_manifest(complete=True)
        return self.pixel_set

    def _write_manifest(self, *, complete: bool) -> None:
        manifest = {
            "format": FORMAT,
            "version": __version__,
            "complete": complete,
            "n_pixels": sum(entry.n_pixels for entry in self._entries.values()),
            "entries": [asdict(entry) for entry in self._entries.values()],
        }
        write_text(self.folder / MANIFEST, json.dumps(manifest, indent=1) + "\n")


def _plain(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return the recipe as it reads back from JSON."""
    plain: dict[str, Any] = json.loads(json.dumps(recipe))
    return plain
