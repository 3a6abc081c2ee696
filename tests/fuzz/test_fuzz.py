"""150 cases of the fuzzer; `python tests/fuzz/run.py` runs as many as asked for."""

import sys
from pathlib import Path

import pytest

from scenes import shell


@pytest.mark.skipif(sys.platform != "linux", reason="forks, and measures memory as Linux does")
def test_150_mutated_inputs():
    """In a process of its own, because a forked process lacks the threads of the other tests."""
    ended = shell(f"{sys.executable} {Path(__file__).with_name('run.py')} --cases 150")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "150 cases" in ended.stdout
