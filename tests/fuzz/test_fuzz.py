"""150 cases of the fuzzer; `python tests/fuzz/run.py` runs as many as asked for."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform != "linux", reason="forks, and measures memory as Linux does")
def test_150_mutated_inputs():
    """In a process of its own, because a forked process lacks the threads of the other tests."""
    script = [sys.executable, str(Path(__file__).with_name("run.py")), "--cases", "150"]
    ended = subprocess.run(script, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "150 cases" in ended.stdout
