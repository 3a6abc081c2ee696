"""Check that what is renamed to its place was on the disk before, as a power cut would need it.

A kill does not lose what was written and not synced, so no kill finds a sync that is missing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

from splinecli.files import COMPLETE

Call = tuple[str, Path, Path]
"""What was called: "sync", "rename" or "remove"; the path, and for "rename" the new one."""


def record_calls(work: Callable[[], object]) -> list[Call]:
    """Do the work and return its calls of the system that sync, rename and remove, in their order."""
    calls: list[Call] = []
    fsync = os.fsync

    def sync(handle: int) -> None:
        fsync(handle)
        path = Path(f"/proc/self/fd/{handle}").readlink()
        calls.append(("sync", path, path))

    def follow(kind: str, change: Callable[..., object]) -> Callable[..., object]:
        def changed(path: str, *more: str, **options: object) -> object:
            done = change(path, *more, **options)
            calls.append((kind, Path(path).absolute(), Path(more[0] if more else path).absolute()))
            return done

        return changed

    changes = {"rename": "rename", "replace": "rename", "unlink": "remove", "remove": "remove"}
    patches = [patch.object(os, name, follow(kind, getattr(os, name))) for name, kind in changes.items()]
    with patch.object(os, "fsync", sync), patches[0], patches[1], patches[2], patches[3]:
        work()
    return calls


def missing_syncs(calls: list[Call]) -> Iterator[str]:
    """Yield what was renamed or removed too early, and the folders whose names may not be on the disk at the end.

    Hidden files are no results, so they may be renamed and removed at any time.
    """
    synced: set[Path] = set()
    changed: dict[Path, Path] = {}  # folders with a name that is not synced: that name
    for kind, path, place in calls:
        if kind == "sync":
            synced.add(path)
            changed.pop(path, None)
            continue
        marked = next((name for name in changed.values() if name.name == COMPLETE), None)
        if marked is not None and path.parent == marked.parent:
            yield f"{path.name} changes before {COMPLETE} is on the disk"
        if kind == "rename":
            if path.name == place.name or not place.name.startswith("."):
                if path not in synced:
                    yield f"{place.name} is renamed before its content is on the disk"
                changed[place.parent] = place
            elif place.name == COMPLETE:
                if path not in synced:
                    yield f"{path.name} is renamed before its names are on the disk"
                changed[place.parent] = place
            synced = {_moved(name, path, place) for name in synced}
    for name in changed.values():
        yield f"the new name {name.name} is not on the disk"


def _moved(path: Path, folder: Path, place: Path) -> Path:
    """Return a path after a rename of a folder, or of the file itself."""
    return place / path.relative_to(folder) if path.is_relative_to(folder) else path
