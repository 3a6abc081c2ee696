"""Help, man pages and completion come from one source, and are answered without PyTorch."""

import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import typer

from make_pages import FILES, man_pages
from scenes import parametrize, run_python
from splinecli.cli.help import EXAMPLES
from splinecli.cli.main import app
from splinecli.estimate.methods import method_names
from splinecli.estimate.networks.weights import shipped_names
from splinecli.records.output_files import MAPS, NORMALS, SURFACE_FILES, own_files
from splinecli.results.pages import INDEX
from splinecli.workshop.training.config import PRESETS

REPOSITORY = Path(__file__).resolve().parents[2]
COMMANDS = (
    "infer",
    "watch",
    "info",
    "calibrate",
    "integrate",
    "evaluate",
    "prepare",
    "train",
    "import-weights",
)


@parametrize("command", ["", *COMMANDS])
def test_help_text(command, run, golden):
    golden(f"help{'_' * bool(command)}{command}.txt", run(f"{command} --help", err="").out)


@parametrize("command", COMMANDS)
def test_help_fits_a_narrow_terminal(command, run, monkeypatch):
    """Descriptions have more than half of the width, so that the help is a few screens long."""
    monkeypatch.setenv("COLUMNS", "80")
    lines = run(f"{command} --help").out.splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) < 170


def test_man_pages_are_up_to_date():
    """Made anew by `python docs/generate.py`; a page of what is no command any more is to be
    removed.
    """
    found = {path.name: path.read_text("utf-8") for path in (REPOSITORY / "man").glob("*.1")}
    assert found == man_pages()


@pytest.mark.skipif(shutil.which("groff") is None, reason="no groff to check the man pages with")
def test_man_pages_are_typeset_without_warnings():
    for name, page in man_pages().items():
        # -ww: all warnings; -z: no output but those.
        done = subprocess.run(
            ["groff", "-man", "-ww", "-z"], input=page, capture_output=True, text=True
        )
        assert (name, done.returncode, done.stderr) == (name, 0, "")


def test_man_page_names_what_infer_writes():
    named = " ".join([*FILES, *FILES.values()])
    assert [name for name in (*own_files(), INDEX) if name not in named] == []


@parametrize("example", EXAMPLES)
def test_examples_of_the_man_pages_are_valid(example, run):
    _, command, *args = shlex.split(example)
    typer.main.get_command(app).commands[command].make_context(command, list(args))  # type: ignore[attr-defined]
    if command not in ("prepare", "train"):  # these would begin
        # Past all that is checked about the command line, up to files that are not there.
        run(command, *args, code=(3, 4))


def test_every_command_has_an_example():
    assert {shlex.split(example)[1] for example in EXAMPLES} == set(COMMANDS)


def test_help_and_ls_do_not_import_torch(capture):
    """`infer --method ls` and all help run without torch; help also without OpenCV."""
    script = (
        "import sys\nfrom splinecli.cli.main import main\nfor line in sys.argv[1:]:\n    code ="
        " main(line.split())\n    print(code, *sorted({'torch', 'cv2'} & set(sys.modules)),"
        " file=sys.stderr)"
    )
    commands = ["--help", "infer --help", "--version", f"infer {capture} --method ls"]
    *helps, ended = run_python(script, *commands, check=True).stderr.splitlines()
    assert helps == ["0", "0", "0"]
    assert ended.split()[0] == "0"
    assert "torch" not in ended


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


def ask(questions):
    """What `splinecli` prints under each of these sets of environment variables."""
    done = run_python(SCRIPT, json.dumps(questions), env=dict(os.environ))
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


def question(line, shell):
    if shell == "bash":
        count = str(len(line.split(" ")) - 1)
        return {"_SPLINECLI_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": count}
    action = {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    return {"_SPLINECLI_COMPLETE": f"complete_{shell}", **action}


def words(out, shell):
    """What the line's last word may become; of zsh and fish without the help beside it."""
    if shell == "zsh":
        return re.findall(r'^(?:_arguments \'\*: :\(\()?"(.*?)"', out, re.MULTILINE)
    return (
        out.split()
        if shell == "bash"
        else [entry.split("\t")[0] for entry in out.splitlines() if entry]
    )


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
