"""Kill a process at a chosen step of its changes to files, as a power cut or `kill -9` would."""

import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate"}
"""Audit events of Python before a change of files. Opening a file for writing is one, too."""


def changes_files(event: str, args: tuple[object, ...]) -> bool:
    if event == "open":
        path, _, flags = args
        return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR)) and path != os.devnull
    return event in CHANGES


def killer(step: int) -> Callable[[str, tuple[object, ...]], None]:
    """Return an audit hook that kills its process before its change number `step`, from 0."""
    left = step

    def count(event: str, args: tuple[object, ...]) -> None:
        nonlocal left
        if changes_files(event, args):
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left -= 1

    return count


def killed_at(step: int, work: Callable[[], object]) -> bool:
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


def content(folder: Path) -> dict[str, bytes]:
    """The content of every file below a folder by its path, hidden ones included."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
