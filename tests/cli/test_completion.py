"""What a shell asks for at the Tab key is answered at once, and by nothing but the answer."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from splinecli.methods import method_names
from splinecli.networks.weights import shipped_names
from splinecli.results.files import MAPS, NORMALS
from splinecli.surface.surface_files import SURFACE_FILES
from splinecli.training.config import PRESETS

SHELLS = ["bash", "zsh", "fish"]


def call(**variables: str) -> str:
    """What `splinecli` prints under these environment variables."""
    # A completion that imported torch would take seconds.
    script = (
        "import sys; from splinecli.cli.main import main\n"
        "try: sys.exit(main([]))\n"
        "finally: print(*{'torch', 'cv2'} & set(sys.modules), end='', file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, **variables}
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def complete(line: str, shell: str = "bash") -> list[str]:
    """What the line's last word may become; of zsh and fish without the help beside it."""
    if shell == "bash":
        words = line.split(" ")
        return call(
            _SPLINECLI_COMPLETE="complete_bash", COMP_WORDS=line, COMP_CWORD=str(len(words) - 1)
        ).split()
    out = call(
        _SPLINECLI_COMPLETE=f"complete_{shell}",
        _TYPER_COMPLETE_ARGS=line,
        _TYPER_COMPLETE_FISH_ACTION="get-args",
    )
    if shell == "fish":
        return [entry.split("\t")[0] for entry in out.splitlines() if entry]
    if out == "_files\n":
        return []
    assert out.startswith("_arguments '*: :((")
    return [entry.split('"')[1] for entry in out.removeprefix("_arguments '*: :((").splitlines()]


@pytest.mark.parametrize("shell", SHELLS)
def test_shells_get_their_scripts(shell):
    script = call(_SPLINECLI_COMPLETE=f"source_{shell}")
    assert f"_SPLINECLI_COMPLETE=complete_{shell}" in script


@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("splinecli in", ["infer", "info", "integrate"]),
        ("splinecli evaluate --me", ["--method"]),
        ("splinecli evaluate data --method ls", ["ls", "ls-trimmed"]),
        ("splinecli infer capture --device c", ["cpu", "cuda"]),
        ("splinecli infer capture --weights cnn", ["cnn-ps"]),
    ],
)
def test_words_are_completed(shell, line, expected):
    assert complete(line, shell) == expected


@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize(
    "line", ["splinecli infer capt", "splinecli info --lights li", "splinecli infer --weights ru"]
)
def test_files_are_left_to_the_shell(shell, line):
    assert complete(line, shell) == []


def test_values_offered_are_all_there_are():
    assert complete("splinecli evaluate --method ") == [*method_names(), "all"]
    assert complete("splinecli train --preset ") == list(PRESETS)
    assert sorted(complete("splinecli train --start-from ")) == shipped_names()
    assert complete("splinecli infer --method ") == method_names()
    assert complete("splinecli infer --maps ") == list(MAPS)
    assert complete("splinecli infer --format ") == list(NORMALS)
    assert complete("splinecli integrate --format ") == list(SURFACE_FILES)
