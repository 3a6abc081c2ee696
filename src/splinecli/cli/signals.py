"""End the process with exit code 130 on Ctrl-C and on SIGTERM, which job schedulers send.

SIGTERM ends the process within two seconds.
"""

import math
import os
import select
import signal
import threading
import time
from contextlib import suppress
from types import FrameType

INTERRUPTED = 130  # exit code of an interrupted process
# time that the command has to clean up
GRACE_SECONDS = {int(signal.SIGTERM): 1.5, int(signal.SIGINT): 5.0}
# set when the command itself reports the interruption, so that it is reported only once
TOLD = threading.Event()
DEFERRED = threading.Event()  # set when a signal arrives during an import, which must finish first


def end_on_signals() -> None:
    """Raise KeyboardInterrupt in the main thread on Ctrl-C and SIGTERM.

    If this does not end the process in time, another thread ends it. Python delivers a signal only
    between two of its instructions, but a call into a library may take minutes, as may the import
    of PyTorch in a thread that has to finish first. An exception in a callback of a library may be
    lost. A separate thread is notified of the signal immediately.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # nohup ignores it
        signal.signal(signal.SIGINT, _interrupt)
    if os.name == "nt":
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()


def ignore_signals() -> None:
    """Ignore SIGTERM and Ctrl-C from now on, because only the exit code remains to be returned."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


def report_interruption() -> int:
    """Print that the process was interrupted, unless this was already printed, and return the exit
    code.
    """
    with suppress(OSError):  # stderr may be closed
        if os.isatty(2):  # the process may end while a progress bar is shown
            os.write(2, b"\r\x1b[2K\x1b[?25h")
        if not TOLD.is_set():
            os.write(2, b"splinecli: interrupted.\n")
    return INTERRUPTED


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or defer it until an import is finished.

    The import of trimesh, for example, continues after any exception.
    """
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            DEFERRED.set()
            again = threading.Timer(0.05, signal.raise_signal, (number,))
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    if number == signal.SIGTERM:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def _watch(reader: int) -> None:
    end = math.inf
    while (left := end - time.monotonic()) > 0:
        if select.select([reader], [], [], None if left == math.inf else left)[0]:
            grace = GRACE_SECONDS.get(os.read(reader, 1)[0], math.inf)
            end = min(end, time.monotonic() + grace)
    os._exit(report_interruption())
