"""Pixel sets: pixels with known normals under many lights, on disk as memory-mapped arrays with a manifest.

    SET/manifest.json                       format, version, entries with counts, recipes and checksums
    SET/<entry>/observations.npy            (P, F), linear, float16 where rendered and float32 where read
    SET/<entry>/normals.npy                 (P, 3) float32, unit
    SET/<entry>/light_directions.npy        (F, 3) float32, unit
    SET/<entry>/mask.npy                    (H, W) bool with P true pixels, in whose row-major order P runs

An entry appears whole, and the manifest names it only then: what an interruption leaves is a set that `prepare`
can go on with. Training refuses a set that is not finished.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli import __version__
from splinecli.errors import InputError, OutputError
from splinecli.files import (
    LOCK,
    check_writable,
    current_umask,
    file_sha256,
    refusals_as_output_errors,
    write_text,
)

FORMAT = "splinecli-pixel-set-1"
MANIFEST = "manifest.json"
_TEMPORARY = ".unfinished-"
ARRAYS = ("observations", "normals", "light_directions", "mask")


@dataclass(frozen=True, eq=False)
class Pixels:
    """The content of one entry; shapes and types as in the files above."""

    observations: NDArray[np.floating]
    normals: NDArray[np.float32]
    light_directions: NDArray[np.float32]
    mask: NDArray[np.bool_]


@dataclass(frozen=True)
class Entry:
    """What the manifest says of an entry.

    Entries of one `scene` share their shape, so they are held together. The recipe holds plain values that
    decide the whole content.
    """

    name: str
    scene: str
    source: str
    recipe: dict[str, Any]
    n_pixels: int
    n_lights: int
    sha256: dict[str, str]


@dataclass(frozen=True)
class PixelSet:
    """A finished, verified set; `sha256` is that of its entries' checksums."""

    folder: Path
    entries: tuple[Entry, ...]

    @property
    def sha256(self) -> str:
        content = json.dumps([[entry.name, entry.sha256] for entry in self.entries], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    def load(self, entry: Entry) -> Pixels:
        """The entry's arrays, mapped and not read. Raises InputError."""
        return _load(self.folder / entry.name)


class PixelSetWriter:
    """Writes a set entry by entry. A set that is there is gone on with: more entries may join it at any time."""

    def __init__(self, folder: Path) -> None:
        """Begin or go on. Raises OutputError where the folder cannot be written or holds something else."""
        check_writable(folder)
        self.folder = folder
        self._entries: dict[str, Entry] = {}
        if (folder / MANIFEST).exists():
            self._entries = {entry.name: entry for entry in _entries(_read_manifest(folder), folder)}
        elif folder.is_dir() and any(path.name != LOCK for path in folder.iterdir()):
            raise OutputError("is not empty and holds no pixel set", path=folder, hint="Choose another -o")
        else:
            self._write_manifest(complete=False)
        for left in folder.glob(f"{_TEMPORARY}*"):  # of a run that was killed while it wrote
            shutil.rmtree(left, ignore_errors=True)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def holds(self, name: str, recipe: dict[str, Any]) -> bool:
        """Whether the entry is there, made by this recipe. Raises OutputError where it is there by another."""
        if name not in self._entries:
            return False
        asked, found = _plain(recipe), self._entries[name].recipe
        for key in [*asked, *found]:
            if asked.get(key) != found.get(key):
                raise OutputError(
                    f"the entry {name} was made with {key} = {found.get(key)!r}, this asks for {asked.get(key)!r}",
                    path=self.folder,
                    hint="Choose another -o",
                )
        return True

    def recipe_of(self, name: str) -> dict[str, Any]:
        """The recipe of an entry that is there."""
        return self._entries[name].recipe

    def describe(self, name: str) -> str:
        """A line on an entry that is there."""
        entry = self._entries[name]
        return f"{name}: {entry.n_pixels} pixels, {entry.n_lights} lights, {entry.source}"

    def add(self, name: str, scene: str, source: str, recipe: dict[str, Any], pixels: Pixels) -> None:
        """Write an entry of at least one pixel. Raises OutputError, and then leaves nothing of it."""
        folder = self.folder / name
        with (
            refusals_as_output_errors(folder),
            tempfile.TemporaryDirectory(prefix=_TEMPORARY, dir=self.folder) as temporary,
        ):
            work = Path(temporary) / "entry"
            work.mkdir()
            for array in ARRAYS:
                np.save(work / f"{array}.npy", getattr(pixels, array), allow_pickle=False)
            checksums = {array: file_sha256(work / f"{array}.npy") for array in ARRAYS}
            work.chmod(0o777 & ~current_umask())
            if folder.exists():  # of a run that was killed between this rename and its manifest
                shutil.rmtree(folder)
            work.rename(folder)
        n_pixels, n_lights = pixels.observations.shape
        self._entries[name] = Entry(name, scene, source, _plain(recipe), n_pixels, n_lights, checksums)
        self._write_manifest(complete=False)

    def finish(self) -> PixelSet:
        """Mark the set as finished. Raises OutputError."""
        self._write_manifest(complete=True)
        return PixelSet(self.folder, tuple(self._entries.values()))

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
    plain: dict[str, Any] = json.loads(json.dumps(recipe))
    return plain


def open_pixel_set(folder: Path) -> PixelSet:
    """A set that is finished and whose files are what the manifest says, every byte.

    Raises:
        InputError: it is not; the message names the file.
    """
    manifest = _read_manifest(folder)
    if manifest.get("complete") is not True:
        raise InputError(
            "the pixel set is not finished", path=folder, hint="Run its 'splinecli prepare' again: it goes on"
        )
    pixel_set = PixelSet(folder, tuple(_entries(manifest, folder)))
    if not pixel_set.entries:
        raise InputError("the pixel set has no entries", path=folder / MANIFEST)
    for entry in pixel_set.entries:
        for array, expected in entry.sha256.items():
            path = folder / entry.name / f"{array}.npy"
            found = file_sha256(path) if path.is_file() else "no such file"
            if found != expected:
                raise InputError(
                    f"does not match the manifest: found {found[:16]}, expected SHA-256 {expected[:16]}...",
                    path=path,
                    hint="Make the set anew with 'splinecli prepare'",
                )
        _check_shapes(entry, pixel_set.load(entry), folder)
    return pixel_set


def _check_shapes(entry: Entry, pixels: Pixels, folder: Path) -> None:
    shapes = {
        "observations": (entry.n_pixels, entry.n_lights),
        "normals": (entry.n_pixels, 3),
        "light_directions": (entry.n_lights, 3),
    }
    for array, expected in shapes.items():
        found = getattr(pixels, array).shape
        if found != expected:
            raise InputError(
                f"does not match the manifest: found an array of shape {found}, expected {expected}",
                path=folder / entry.name / f"{array}.npy",
            )


def _load(folder: Path) -> Pixels:
    arrays = []
    for array in ARRAYS:
        path = folder / f"{array}.npy"
        try:
            # As plain arrays: every slice of a memmap object costs ten times as much.
            arrays.append(np.asarray(np.load(path, mmap_mode="r", allow_pickle=False)))
        except (OSError, ValueError) as error:
            raise InputError(f"cannot be read as an array ({error})", path=path) from error
    return Pixels(*arrays)


def _read_manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        manifest: Any = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(
            f"no pixel set: its {MANIFEST} cannot be read ({error.strerror})",
            path=folder,
            hint="Make one with 'splinecli prepare SOURCE -o SET' or 'splinecli prepare --scenes N -o SET'",
        ) from error
    except ValueError as error:
        raise InputError(f"is not JSON ({error})", path=path) from error
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if found != FORMAT:
        raise InputError(
            f"is no manifest of a pixel set: found format {found!r}, expected {FORMAT!r}", path=path
        )
    valid: dict[str, Any] = manifest
    return valid


def _entries(manifest: dict[str, Any], folder: Path) -> list[Entry]:
    try:
        entries = [Entry(**values) for values in manifest["entries"]]
        # A checksum left out would be a file left unchecked.
        complete = all(isinstance(entry.sha256.get(array), str) for entry in entries for array in ARRAYS)
    except (AttributeError, KeyError, TypeError) as error:
        raise InputError(f"an entry is incomplete ({error})", path=folder / MANIFEST) from error
    if not complete:
        raise InputError("an entry is incomplete (a checksum is missing)", path=folder / MANIFEST)
    return entries
