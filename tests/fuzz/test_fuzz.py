"""300 cases of the fuzzer; `python tests/fuzz/run.py` runs as many as asked for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform != "linux", reason="forks, and measures memory as Linux does")
def test_300_mutated_inputs() -> None:
    """In a process of its own, because a forked process lacks the threads of the other tests."""
    command = [sys.executable, str(Path(__file__).with_name("run.py")), "--cases", "300"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "300 cases" in done.stdout
