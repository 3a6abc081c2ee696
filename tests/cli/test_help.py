"""Help, man page and README come from one source, and starting up stays cheap."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from splinecli.cli.man import man_page

REPOSITORY = Path(__file__).resolve().parents[2]


COMMANDS = ["infer", "info", "calibrate", "integrate", "evaluate", "prepare", "train", "import-weights"]


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_text(command, run, golden):
    result = run(*filter(None, [command]), "--help")
    assert (result.code, result.err) == (0, "")
    golden(f"help{'_' * bool(command)}{command}.txt", result.out)


def test_man_page_is_up_to_date():
    """Made anew by `python -m splinecli.cli.man > man/splinecli.1`."""
    assert (REPOSITORY / "man/splinecli.1").read_text("utf-8") == man_page()


def test_man_page_names_every_option(run):
    page = man_page().replace("\\-", "-")
    for command in COMMANDS:
        options = [word for word in run(command, "--help").out.split() if word.startswith("--")]
        assert options
        for option in options:
            assert option.rstrip(",.;") in page


def test_readme_holds_the_help(run):
    readme = (REPOSITORY / "README.md").read_text("utf-8")
    assert f"```text\n$ splinecli infer --help\n{run('infer', '--help').out}```\n" in readme


def test_help_and_ls_do_not_import_torch(capture):
    """`infer --method ls` and all help run without torch; help also without OpenCV and rich."""
    script = (
        "import sys; from splinecli.cli import main; code = main(sys.argv[1:]);"
        "print(code, *sorted({'torch', 'cv2', 'rich'} & set(sys.modules)), file=sys.stderr)"
    )

    def loaded(*args: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", script, *args],
            capture_output=True,
            text=True,
            check=True,
            cwd=capture.parent,
        )
        return done.stderr.strip()

    assert loaded("--help") == "0"
    assert loaded("infer", "--help") == "0"
    assert loaded("--version") == "0"
    ended = loaded("infer", str(capture), "--method", "ls").split()
    assert ended[0] == "0"
    assert "torch" not in ended
