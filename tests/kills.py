"""Kill a process at a chosen step of its changes to files, and check that what it renames is on the
disk before.
"""

import os
import signal
import sys
import traceback
from functools import partial
from itertools import count
from pathlib import Path
from unittest.mock import patch

CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate"}
"""Audit events of Python before a change of files. Opening a file for writing is one, too."""


def changes_files(event, args):
    if event == "open":
        path, _, flags = args
        return (
            isinstance(flags, int)
            and bool(flags & (os.O_WRONLY | os.O_RDWR))
            and path != os.devnull
        )
    return event in CHANGES


def killer(step):
    """Return an audit hook that kills its process before its change number `step`, from 0."""
    left = step

    def count(event, args):
        nonlocal left
        if changes_files(event, args):
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left -= 1

    return count


def killed_at(step, work):
    """Run `work` in a forked process and kill it (SIGKILL) before its change number `step`, from 0.

    Returns:
        False if the work ended before that.
    """
    child = os.fork()
    if child:
        _, status = os.waitpid(child, 0)
        if os.WIFSIGNALED(status):
            assert os.WTERMSIG(status) == signal.SIGKILL
            return True
        assert os.WEXITSTATUS(status) == 0, "the work failed"
        return False
    try:
        sys.addaudithook(killer(step))
        work()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def killed_at_every_step(place, prepare, work):
    """Yield a folder for each change of files of the work: prepared, and killed before it."""
    for step in count():
        folder = place / str(step)
        prepare(folder)
        if not killed_at(step, partial(work, folder)):
            return
        yield folder


def content(folder):
    """The content of every file below a folder by its path, hidden ones included."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def record_calls(work):
    """Do the work and return its calls of the system in their order: "sync", "rename" or "remove",
    the path, and for "rename" the new one.
    """
    calls = []
    fsync = os.fsync

    def sync(handle):
        fsync(handle)
        path = Path(f"/proc/self/fd/{handle}").readlink()
        calls.append(("sync", path, path))

    def follow(kind, change):
        def changed(path, *more, **options):
            done = change(path, *more, **options)
            calls.append((kind, Path(path).absolute(), Path(more[0] if more else path).absolute()))
            return done

        return changed

    kinds = {"rename": "rename", "replace": "rename", "unlink": "remove", "remove": "remove"}
    changes = {name: follow(kind, getattr(os, name)) for name, kind in kinds.items()}
    with patch.multiple(os, fsync=sync, **changes):
        work()
    return calls


def missing_syncs(calls, report):
    """Yield what was changed too early, and the folders whose names may not be on the disk at the
    end.

    A kill does not lose what was written and not synced, but a power cut does. So a file must be
    synced before it is renamed. The removal of a report must be on the disk before any file gets
    its place, and the names of all these files before the report gets its own. Hidden files are no
    results.
    """
    if not any(kind == "rename" for kind, _, _ in calls):
        yield "nothing is renamed"
    synced, changed = set(), {}  # folders with a name that is not synced: that name
    for kind, path, place in calls:
        if kind == "sync":
            synced.add(path)
            changed.pop(path, None)
        elif not place.name.startswith("."):
            if kind == "rename" and path not in synced:
                yield f"{place.name} is renamed before its content is on the disk"
            unsynced = (
                changed.values()
                if place.name == report
                else [n for n in changed.values() if n.name == report]
            )
            for name in unsynced:
                yield f"{place.name} changes before {name.name} is on the disk"
            changed[place.parent] = place
    for name in changed.values():
        yield f"the new name {name.name} is not on the disk"
