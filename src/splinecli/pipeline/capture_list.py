"""The captures of a batch: each folder once, with its name, and which of them belong to a shard."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from splinecli.capture import capture_name
from splinecli.capture.formats.film import is_film
from splinecli.capture.paths import find_mode, resolve
from splinecli.errors import InputError, UsageError
from splinecli.methods import method_names
from splinecli.results.files import MAPS, NORMALS

_SHARD = re.compile(r"([0-9]{1,18})/([0-9]{1,18})")


class Shard(NamedTuple):
    """Part `number` of a batch of `n_parts`, counted from 1."""

    number: int
    n_parts: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Return the shard of "3/8". Raises UsageError."""
        found = _SHARD.fullmatch(text)
        if found is None:
            raise UsageError(f"--shard is {text!r}; expected I/N, such as 3/8 for the third of eight parts")
        number, count = int(found[1]), int(found[2])
        if not 1 <= number <= count:
            raise UsageError(
                f"--shard is {number}/{count}; expected I/N with I from 1 to N",
                hint="If your job numbers count from 0, add 1",
            )
        return cls(number, count)


@dataclass(frozen=True)
class Member:
    """A capture of a batch. `missing` says why it cannot be read, if there is no such folder."""

    folder: Path
    name: str
    missing: InputError | None = None


def list_captures(folders: Sequence[Path], shard: Shard | None = None) -> list[Member]:
    """Return the captures in the order given. A folder that is given twice counts once.

    Raises UsageError if two captures have the same name, or a "folder" that does not exist is the name of a map, format
    or method.
    """
    folders = list({_own_path(folder): folder for folder in reversed(folders)}.values())[::-1]
    chosen = set(folders)
    if shard is not None:
        # In the order of their bytes: a shell sorts captures/* by its language, and the machines of a cluster may
        # differ in that.
        chosen = set(sorted(folders, key=os.fsencode)[shard.number - 1 :: shard.n_parts])
    # Also of the other shards, because their results go to the same place.
    members = {folder: _member(folder) for folder in folders}
    seen: dict[str, Path] = {}
    for folder, member in members.items():
        if member.missing is None and (other := seen.setdefault(member.name, folder)) is not folder:
            raise UsageError(
                f"{other} and {folder} have the same name, so their results would overwrite each other",
                hint="Run them one by one with different -o",
            )
    return [member for folder, member in members.items() if folder in chosen]


def _own_path(folder: Path) -> Path:
    """Return one path for all spellings of a folder. A link keeps its name, because its results have it."""
    try:
        return resolve(folder) if ".." in folder.parts else folder.absolute()
    except InputError:
        return folder  # what is wrong with it is reported when its turn comes


def _member(folder: Path) -> Member:
    """Return the capture in the folder. Raises UsageError for a word of another option."""
    # What is wrong with a folder that cannot be read is reported when its turn comes.
    try:
        exists = find_mode(folder) is not None
    except InputError:
        exists = True
    if exists:
        try:
            return Member(folder, capture_name(folder))
        except InputError:
            return Member(folder, folder.name)
    if str(folder) in (*MAPS, *NORMALS, *method_names()):
        raise UsageError(
            "the folder does not exist", path=folder, hint="Write lists with commas, such as --maps albedo,confidence"
        )
    kind = "film" if is_film(folder) else "folder"
    return Member(folder, folder.name or str(folder), InputError(f"the {kind} does not exist", path=folder))
