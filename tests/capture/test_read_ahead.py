"""Reading ahead: the order, errors, and messages that are printed meanwhile."""

import subprocess
import sys
import threading

import pytest

from splinecli.capture import source as module
from splinecli.capture.source import read_ahead


@pytest.fixture(params=[True, False])
def stderr_is_apart(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    apart: bool = request.param
    monkeypatch.setattr(module, "stderr_is_apart", lambda: apart)
    return apart


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_all_come_in_their_order(stderr_is_apart: bool, count: int) -> None:
    assert list(read_ahead(lambda item: 10 * item, range(count))) == [10 * item for item in range(count)]


def test_the_next_item_is_read_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "stderr_is_apart", lambda: True)
    begun = [threading.Event() for _ in range(4)]
    for item in (images := read_ahead(lambda item: begun[item].set() or item, range(4))):
        assert begun[min(item + 1, 3)].wait(10)
        assert not any(event.is_set() for event in begun[item + 2 :])
    assert next(images, None) is None


def test_messages_of_the_command_are_not_caught_with_those_of_the_libraries() -> None:
    script = """
import os, sys
from contextlib import redirect_stderr
from splinecli.capture.formats.decoders import native_stderr, stderr_is_apart
from splinecli.cli.main import _apart
assert not stderr_is_apart()
with redirect_stderr(_apart(sys.stderr)):
    assert stderr_is_apart()
    with native_stderr() as messages:
        print("12 %", file=sys.stderr)
        os.write(2, b"libpng warning")
assert messages == ["libpng warning"], messages
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stderr == "12 %\n"
