"""Ctrl-C and SIGTERM at awkward moments."""

from __future__ import annotations

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
import sys, time
from splinecli import __main__
from splinecli.cli import main
def work():
    import library
    print("imported", flush=True)
    time.sleep(20)
main.main = work
__main__.run()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
@pytest.mark.parametrize("signal", ["SIGINT", "SIGTERM"])
def test_a_library_that_swallows_interrupts_while_it_is_imported(tmp_path: Path, signal: str) -> None:
    (tmp_path / "library.py").write_text(LIBRARY.format(signal=signal))
    done = subprocess.run(
        [sys.executable, "-c", COMMAND], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "imported\n", "splinecli: interrupted.\n")
