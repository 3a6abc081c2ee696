"""Help and man pages come from one source, and starting up stays cheap."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from make_pages import EXAMPLES, FILES, man_pages
from splinecli.cli.main import app
from splinecli.output_files import own_files
from splinecli.results.pages import INDEX

REPOSITORY = Path(__file__).resolve().parents[2]
COMMANDS = ["infer", "watch", "info", "calibrate", "integrate", "evaluate", "prepare", "train", "import-weights"]


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_text(command, run, golden):
    result = run(*filter(None, [command]), "--help")
    assert (result.code, result.err) == (0, "")
    golden(f"help{'_' * bool(command)}{command}.txt", result.out)


def test_man_pages_are_up_to_date():
    """Made anew by `python man/make_pages.py`; a page of what is no command any more is to be removed."""
    found = {path.name: path.read_text("utf-8") for path in (REPOSITORY / "man").glob("*.1")}
    assert found == man_pages()


@pytest.mark.skipif(shutil.which("groff") is None, reason="no groff to check the man pages with")
def test_man_pages_are_typeset_without_warnings():
    for name, page in man_pages().items():
        # -ww: all warnings; -z: no output but those.
        done = subprocess.run(["groff", "-man", "-ww", "-z"], input=page, capture_output=True, text=True)
        assert (name, done.returncode, done.stderr) == (name, 0, "")


def test_man_page_names_what_infer_writes():
    named = " ".join([*FILES, *FILES.values()])
    assert [name for name in (*own_files(), INDEX) if name not in named] == []


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_of_the_man_pages_are_valid(example, run):
    _, command, *args = shlex.split(example)
    typer.main.get_command(app).commands[command].make_context(command, list(args))
    if command not in ("prepare", "train"):  # these would begin
        # Past all that is checked about the command line, up to files that are not there.
        assert run(command, *args).code in (3, 4)


def test_every_command_has_an_example():
    assert {shlex.split(example)[1] for example in EXAMPLES} == set(COMMANDS)


def test_help_and_ls_do_not_import_torch(capture):
    """`infer --method ls` and all help run without torch; help also without OpenCV."""
    script = (
        "import sys\nfrom splinecli.cli.main import main\nfor line in sys.argv[1:]:\n    code = main(line.split())\n"
        "    print(code, *sorted({'torch', 'cv2'} & set(sys.modules)), file=sys.stderr)"
    )
    commands = ["--help", "infer --help", "--version", f"infer {capture} --method ls"]
    call = [sys.executable, "-c", script, *commands]
    done = subprocess.run(call, capture_output=True, text=True, check=True, cwd=capture.parent)
    *helps, ended = done.stderr.splitlines()
    assert helps == ["0", "0", "0"]
    assert ended.split()[0] == "0"
    assert "torch" not in ended
