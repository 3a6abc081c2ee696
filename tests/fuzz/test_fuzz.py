"""300 cases of the fuzzer; `python tests/fuzz/run.py` runs as many as asked for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform != "linux", reason="forks, and measures memory as Linux does")
def test_300_mutated_inputs() -> None:
    """In two processes of their own, because a forked process lacks the threads of the other tests."""
    script = [sys.executable, str(Path(__file__).with_name("run.py")), "--cases", "150"]
    halves = [
        subprocess.Popen(
            [*script, "--first", first], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        for first in ("0", "150")
    ]
    for half in halves:
        text, _ = half.communicate()
        assert half.returncode == 0, text
        assert "150 cases" in text
