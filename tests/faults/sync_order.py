"""Check that what is renamed to its place was on the disk before, as a power cut would need it.

A kill does not lose what was written and not synced, so no kill finds a sync that is missing.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

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


def missing_syncs(calls: list[Call], report: str | None) -> Iterator[str]:
    """Yield what was changed too early, and the folders whose names may not be on the disk at the end.

    A file must be synced before it is renamed. The removal of a report must be on the disk before any file gets its
    place, and the names of all these files before the report gets its own. Hidden files are no results.
    """
    synced: set[Path] = set()
    changed: dict[Path, Path] = {}  # folders with a name that is not synced: that name
    for kind, path, place in calls:
        if kind == "sync":
            synced.add(path)
            changed.pop(path, None)
        elif not place.name.startswith("."):
            if kind == "rename" and path not in synced:
                yield f"{place.name} is renamed before its content is on the disk"
            unsynced = changed.values() if place.name == report else [n for n in changed.values() if n.name == report]
            for name in unsynced:
                yield f"{place.name} changes before {name.name} is on the disk"
            changed[place.parent] = place
    for name in changed.values():
        yield f"the new name {name.name} is not on the disk"
