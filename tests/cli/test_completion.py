"""What a shell asks for at the Tab key is answered at once, and by nothing but the answer."""

import json
import os
import re
import subprocess
import sys

from splinecli.methods import method_names
from splinecli.networks.weights import shipped_names
from splinecli.output_files import MAPS, NORMALS
from splinecli.surface.surface_files import SURFACE_FILES
from splinecli.training.config import PRESETS

# A completion that imported torch would take seconds.
SCRIPT = """
import contextlib, io, json, os, sys
from splinecli.cli.main import main
answers = []
for variables in json.loads(sys.argv[1]):
    os.environ.update(variables)
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        assert not main([])
    answers.append(out.getvalue())
assert not {'torch', 'cv2'} & set(sys.modules)
print(json.dumps(answers))
"""


def ask(questions: list[dict[str, str]]) -> list[str]:
    """What `splinecli` prints under each of these sets of environment variables."""
    arguments = [sys.executable, "-c", SCRIPT, json.dumps(questions)]
    done = subprocess.run(arguments, capture_output=True, text=True, env=dict(os.environ))
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


def question(line: str, shell: str) -> dict[str, str]:
    if shell == "bash":
        count = str(len(line.split(" ")) - 1)
        return {"_SPLINECLI_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": count}
    action = {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    return {"_SPLINECLI_COMPLETE": f"complete_{shell}", **action}


def words(out: str, shell: str) -> list[str]:
    """What the line's last word may become; of zsh and fish without the help beside it."""
    if shell == "zsh":
        return re.findall(r'^(?:_arguments \'\*: :\(\()?"(.*?)"', out, re.MULTILINE)
    return out.split() if shell == "bash" else [entry.split("\t")[0] for entry in out.splitlines() if entry]


COMPLETED = {
    "splinecli in": ["infer", "info", "integrate"],
    "splinecli evaluate --me": ["--method"],
    "splinecli info --l": [
        "--light-distance",
        "--light-frame",
        "--light-positions",
        "--lights",
        "--light-format",
        "--lights-in-channels",
    ],
    "splinecli evaluate data --method ls": ["ls", "ls-trimmed"],
    "splinecli infer capture --device c": ["cpu", "cuda"],
    "splinecli infer capture --weights cnn": ["cnn-ps"],
    # Files are left to the shell.
    "splinecli infer capt": [],
    "splinecli info --lights li": [],
    "splinecli infer --weights ru": [],
    # Values offered are all that there are.
    "splinecli evaluate --method ": [*method_names(), "all"],
    "splinecli train --preset ": list(PRESETS),
    "splinecli train --start-from ": list(shipped_names()),
    "splinecli infer --method ": method_names(),
    "splinecli infer --maps ": list(MAPS),
    "splinecli infer --format ": list(NORMALS),
    "splinecli integrate --format ": list(SURFACE_FILES),
}


def test_words_are_completed():
    shells = ("bash", "zsh", "fish")
    scripts = [{"_SPLINECLI_COMPLETE": f"source_{shell}"} for shell in shells]
    answers = iter(ask(scripts + [question(line, shell) for shell in shells for line in COMPLETED]))
    for shell in shells:
        assert f"_SPLINECLI_COMPLETE=complete_{shell}" in next(answers)
    for shell in shells:
        found = {line: sorted(words(next(answers), shell)) for line in COMPLETED}
        assert found == {line: sorted(expected) for line, expected in COMPLETED.items()}, shell
