"""SIGTERM, which job schedulers send, ends the process like Ctrl-C, and within two seconds."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from typing import Any, NoReturn

INTERRUPTED = 130
"""Exit code of an interrupted process."""

GRACE_SECONDS = 1.5
"""Time that the command has to clean up."""


def end_on_sigterm() -> None:
    """Raise KeyboardInterrupt in the main thread at SIGTERM, and end the process if that does not end it.

    Python delivers a signal only between two of its instructions. One call into a library may take minutes, and an
    exception in a callback of a library is lost. Another thread learns of the signal at once.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    if os.name == "nt":
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()


def ignore_signals() -> None:
    """Ignore SIGTERM and Ctrl-C from now on: the work is done, and only its exit code is still to be told."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


def report_interruption() -> int:
    """Print that the process was interrupted, without Python's streams, and return the exit code."""
    with suppress(OSError):  # stderr is closed
        os.write(2, b"splinecli: interrupted.\n")
    return INTERRUPTED


def _interrupt(number: int, frame: Any) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def _watch(reader: int) -> None:
    """Read the numbers of the signals that arrive, and end the process some time after a SIGTERM."""
    while os.read(reader, 1) != bytes([signal.SIGTERM]):
        pass
    time.sleep(GRACE_SECONDS)
    os._exit(report_interruption())
