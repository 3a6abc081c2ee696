"""The process: Ctrl-C and SIGTERM at awkward moments, and nothing on stderr but messages."""

import subprocess
import sys
from pathlib import Path

import pytest

LIBRARY = """
import os, signal
try:
    os.kill(os.getpid(), signal.{signal})
    for _ in range(100_000):
        pass
except BaseException:
    print("swallowed")
"""
COMMAND = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
from splinecli import __main__
from splinecli.cli import main
def work():
    import library
    print("imported", flush=True)
    for _ in range(200):
        time.sleep(0.1)
main.main = work
__main__.run()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
@pytest.mark.parametrize("signal", ["SIGINT", "SIGTERM"])
def test_a_library_that_swallows_interrupts_while_it_is_imported(tmp_path: Path, signal: str) -> None:
    (tmp_path / "library.py").write_text(LIBRARY.format(signal=signal))
    done = subprocess.run([sys.executable, "-c", COMMAND], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "imported\n", "splinecli: interrupted.\n")


def test_libraries_print_nothing(tmp_path: Path) -> None:
    command = """
import logging, sys, warnings
from splinecli import __main__
from splinecli.cli import main
@main.app.command()
def noisy():
    logging.getLogger("library").error("a log")
    warnings.warn("a warning", RuntimeWarning)
sys.argv = ["splinecli", "noisy"]
__main__.run()
"""
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_an_interruption_is_told_once(capfd, monkeypatch):
    """The thread that ends the process after a SIGTERM may come when the command has told of it."""
    from splinecli.cli import main, signals

    monkeypatch.setattr(main.typer.main, "get_command", lambda _: type("Stub", (), {"main": lambda *_, **__: 130}))
    try:
        assert main.main([]) == signals.report_interruption() == 130
    finally:
        main.TOLD.clear()
    assert capfd.readouterr().err == "splinecli: interrupted.\n"
