"""Progress and messages of the commands: a bar on a terminal, a line every half minute elsewhere."""

import contextlib
import os
import subprocess
import sys

import pytest

from splinecli.cli import console
from splinecli.cli.console import Messages


def test_a_line_every_half_minute_off_a_terminal(capsys, monkeypatch):
    now = 0.0
    monkeypatch.setattr(console, "LINE_SECONDS", 30)
    monkeypatch.setattr(console.time, "monotonic", lambda: now)
    with Messages(quiet=False).progress("cat: estimating", 400) as advance:
        for _ in range(400):
            now += 0.25
            advance(1, "calm")
    lines = [f"cat: estimating: {share} %, {100 - share} s left, calm" for share in (30, 60, 90)]
    assert capsys.readouterr().err.splitlines() == lines
    with Messages(quiet=False).progress("cat: refining", 100_000, unit="pixels") as advance:
        now += 40
        advance(25_000)
    assert capsys.readouterr().err == "cat: refining: 25 %, 625 pixels/s, 120 s left\n"
    with Messages(quiet=True).progress("cat: estimating", 1) as advance:
        now += 100
        advance(0.5)
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(os.name == "nt", reason="POSIX terminals")
def test_the_bar_moves_at_least_twice_a_second_on_a_terminal():
    """A bar that is advanced every tenth of a second shows at least four percentages in 2.5 seconds."""
    import pty

    script = """
import time
from splinecli.cli.console import Messages
with Messages(quiet=False).progress("cat", 25) as advance:
    for _ in range(25):
        time.sleep(0.1)
        advance(1)
"""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80"}
    process = subprocess.Popen([sys.executable, "-c", script], stderr=theirs, env=environment)
    os.close(theirs)
    shown = b""
    with contextlib.suppress(OSError):  # when the terminal is closed
        while block := os.read(ours, 65536):
            shown += block
    assert process.wait() == 0
    percentages = {part.split()[-1] for part in shown.decode().split("%")[:-1] if part.split()}
    assert len(percentages) >= 4
