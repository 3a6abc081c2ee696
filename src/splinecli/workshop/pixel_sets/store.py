"""Pixel sets on disk: pixels with known normals under many lights, as memory-mapped arrays and a
manifest.

A set SET contains

- manifest.json: format, version, and the entries with counts, recipes and checksums;
- <entry>/observations.npy: (P, F), linear, float16 if rendered and float32 if read from a capture;
- <entry>/normals.npy: (P, 3) float32, unit;
- <entry>/light_directions.npy: (F, 3) float32, unit;
- <entry>/mask.npy: (H, W) bool with P true pixels, where P is in row-major order.

Sets are written entry by entry, so that an interrupted command can continue. An unfinished set is
not accepted for training.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, ValidationError, convert, to_builtins
from numpy.typing import NDArray

from splinecli._version import __version__
from splinecli.errors import InputError, OutputError
from splinecli.records.base import Count
from splinecli.system.files import check_writable, file_sha256, read_json, write_text
from splinecli.system.machine import is_out_of_memory
from splinecli.system.publishing import LOCK, new_files

FORMAT = "splinecli-pixel-set-1"
MANIFEST = "manifest.json"
ARRAYS = ("observations", "normals", "light_directions", "mask")


@dataclass(frozen=True, eq=False)
class Pixels:
    """The arrays of one entry, with the shapes and types listed above."""

    observations: NDArray[np.floating]
    normals: NDArray[np.float32]
    light_directions: NDArray[np.float32]
    mask: NDArray[np.bool_]


class Entry(Struct, frozen=True):
    """The description of an entry in the manifest."""

    name: str  # the folder of the entry, unique in its set
    # entries of one scene have the same shape, so they are all for training or all for validation
    scene: str
    source: str  # description of where the pixels come from, for the user
    recipe: dict[str, Any]  # plain values that determine the content of the entry
    n_pixels: Count  # P
    n_lights: Count  # F
    sha256: dict[str, str]  # checksum of each array file, by the name of the array


class Manifest(Struct):
    """The manifest of a set."""

    format: str
    version: str
    complete: bool  # whether the set is finished
    n_pixels: int
    entries: tuple[Entry, ...]


@dataclass(frozen=True)
class PixelSet:
    """A finished set whose files match its manifest."""

    folder: Path
    entries: tuple[Entry, ...]

    @property
    def sha256(self) -> str:
        """SHA-256 of the names and checksums of all entries."""
        content = json.dumps([[entry.name, entry.sha256] for entry in self.entries], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    @property
    def file_names(self) -> list[str]:
        """The names of the files of all entries."""
        return [f"{entry.name}/{array}.npy" for entry in self.entries for array in ARRAYS]

    def load(self, entry: Entry) -> Pixels:
        """Return the arrays of an entry, mapped into memory.

        Raises InputError if they do not match the manifest.
        """
        # Convert to plain arrays, because slicing an np.memmap object takes ten times as long.
        pixels = Pixels(
            *(np.asarray(_map(self.folder / entry.name / f"{array}.npy")) for array in ARRAYS)
        )
        _check_arrays(entry, pixels, self.folder)
        return pixels


def open_pixel_set(folder: Path) -> PixelSet:
    """Open a set after comparing every file with the checksums in its manifest.

    Raises InputError, which names the file, if the set is unfinished or empty, or if a file is
    missing or was changed.
    """
    manifest = read_manifest(folder)
    if not manifest.complete:
        raise InputError(
            "the pixel set is not finished",
            path=folder,
            hint="Run the same 'splinecli prepare' again to finish it",
        )
    pixel_set = PixelSet(folder, manifest.entries)
    if not pixel_set.entries:
        raise InputError("the pixel set has no entries", path=folder / MANIFEST)
    for entry in pixel_set.entries:
        _check_checksums(entry, folder)
        pixel_set.load(entry)
    return pixel_set


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a set, finished or not.

    Raises InputError, which names the field that is missing or invalid.
    """
    path = folder / MANIFEST
    try:
        values = read_json(path)
    except OSError as error:
        raise InputError(
            f"not a pixel set: its {MANIFEST} cannot be read ({error.strerror})",
            path=folder,
            hint=(
                "Make one with 'splinecli prepare SOURCE -o SET' or 'splinecli prepare --scenes N"
                " -o SET'"
            ),
        ) from error
    except ValueError as error:
        raise InputError(f"not JSON ({error})", path=path) from error
    found = values.get("format") if isinstance(values, dict) else None
    if found != FORMAT:
        raise InputError(
            f"not the manifest of a pixel set: found format {found!r}, expected {FORMAT!r}",
            path=path,
        )
    try:
        manifest = convert(values, Manifest)
    except ValidationError as error:
        raise InputError(f"the manifest is damaged ({error})", path=path) from error
    for entry in manifest.entries:
        if (
            not set(ARRAYS) <= entry.sha256.keys()
        ):  # a file without a checksum would not be verified
            raise InputError(
                f"the manifest is damaged (the entry {entry.name!r} lacks a checksum)", path=path
            )
        if (
            not entry.name
            or entry.name == ".."
            or "\0" in entry.name
            or Path(entry.name).name != entry.name
        ):
            raise InputError(f"{entry.name!r} is not the name of a folder", path=path)
    return manifest


def _check_checksums(entry: Entry, folder: Path) -> None:
    for array in ARRAYS:
        path, expected = folder / entry.name / f"{array}.npy", entry.sha256[array]
        mapped = _map(path)
        # A file longer than its array is rejected.
        is_whole = path.stat().st_size == mapped.offset + mapped.nbytes
        found = file_sha256(path)[:16] if is_whole else "another length"
        if found != expected[:16]:
            raise _mismatch(path, found, f"SHA-256 {expected[:16]}...")


def _check_arrays(entry: Entry, pixels: Pixels, folder: Path) -> None:
    expected = {
        "observations": (entry.n_pixels, entry.n_lights),
        "normals": (entry.n_pixels, 3),
        "light_directions": (entry.n_lights, 3),
    }
    for array, shape in expected.items():
        found = getattr(pixels, array)
        if found.shape != shape or found.dtype.kind != "f":
            path = folder / entry.name / f"{array}.npy"
            raise _mismatch(
                path, f"an array of shape {found.shape}, {found.dtype}", f"{shape}, float"
            )
    mask = pixels.mask
    if mask.ndim != 2 or mask.dtype != bool or np.count_nonzero(mask) != entry.n_pixels:
        path = folder / entry.name / "mask.npy"
        raise _mismatch(path, "another mask", f"(H, W), bool, with {entry.n_pixels} true pixels")


def _map(path: Path) -> np.memmap[Any, Any]:
    """Return the array in a file, mapped into memory. Raises InputError."""
    if not path.is_file():
        raise _mismatch(path, "no plain file", "an array")
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # a damaged header can raise a dozen types of errors
        if is_out_of_memory(error):
            raise
        raise _mismatch(path, "no array", "one") from error


def _mismatch(path: Path, found: str, expected: str) -> InputError:
    return InputError(
        f"does not match the manifest: found {found}, expected {expected}",
        path=path,
        hint=(
            "Remove the folder of the set, or choose another -o, and run 'splinecli prepare' again"
        ),
    )


class PixelSetWriter:
    """Writes a new set, or adds entries to an existing one, finished or not.

    The manifest never lists an entry while its files are being changed, because the entry is
    removed before and added afterwards.
    """

    def __init__(self, folder: Path) -> None:
        """Open the folder.

        Raises OutputError if it cannot be written or contains other files, and InputError if the
        set is damaged.
        """
        check_writable(folder)
        self.folder = folder
        self._entries: dict[str, Entry] = {}
        if (folder / MANIFEST).exists():
            self._entries = {entry.name: entry for entry in read_manifest(folder).entries}
        elif folder.is_dir() and any(path.name != LOCK for path in folder.iterdir()):
            raise OutputError(
                "has files in it but is not a pixel set", path=folder, hint="Choose another -o"
            )
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
        """Return a description of the first setting in which an entry's recipe differs; None if
        there is none.
        """
        asked, found = _plain(recipe), self._entries[name].recipe
        for key in [*asked, *found]:
            if asked.get(key) != found.get(key):
                return f"{key} = {found.get(key)!r}, not {asked.get(key)!r}"
        return None

    def describe(self, name: str) -> str:
        """Return a one-line description of an entry for the user."""
        entry = self._entries[name]
        return f"{name}: {entry.n_pixels} pixels, {entry.n_lights} lights, {entry.source}"

    def add(
        self, name: str, scene: str, source: str, recipe: dict[str, Any], pixels: Pixels
    ) -> None:
        """Write an entry of at least one pixel, replacing any earlier entry with the same name.

        The other entries are not affected. Raises OutputError if it cannot be written.
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
        self._entries[name] = Entry(
            name, scene, source, _plain(recipe), n_pixels, n_lights, checksums
        )
        self._write_manifest(complete=False)

    def finish(self) -> PixelSet:
        """Mark the set as finished and return it. Raises OutputError."""
        self._write_manifest(complete=True)
        return self.pixel_set

    def _write_manifest(self, *, complete: bool) -> None:
        entries = tuple(self._entries.values())
        manifest = Manifest(
            FORMAT, __version__, complete, sum(entry.n_pixels for entry in entries), entries
        )
        write_text(self.folder / MANIFEST, json.dumps(to_builtins(manifest), indent=1) + "\n")


def _plain(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return the recipe as read back from JSON."""
    plain: dict[str, Any] = json.loads(json.dumps(recipe))
    return plain
