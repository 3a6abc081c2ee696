"""What all commands share: panels in the help, `~` in paths, closed pipes, progress, and threads
that sleep.
"""

import contextlib
import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer

from cli.test_schema import check
from scenes import names_in, parametrize, put, run_python
from splinecli.cli import console
from splinecli.cli.console import Messages, explain
from splinecli.cli.main import app
from splinecli.records.base import PANELS


def test_every_option_stands_in_a_panel():
    commands = typer.main.get_command(app).commands.values()  # type: ignore[attr-defined]
    options = [
        one for command in commands for one in command.params if one.param_type_name == "option"
    ]
    assert {option.rich_help_panel for option in options} <= set(PANELS)


def test_home_folders_are_expanded(capture, run, monkeypatch):
    monkeypatch.setenv("HOME", str(capture.parent.absolute()))
    monkeypatch.setenv("USERPROFILE", str(capture.parent.absolute()))
    call = "infer ~/sphere --lights=~/sphere/light_directions.txt --output=~/results"
    run(f"{call} --method ls")
    assert Path("results/sphere/report.json").is_file()
    run("info ~/sphere --mask=~/sphere/mask.png --plot=~/sky.png")
    assert Path("sky.png").is_file()
    run("integrate ~/results/sphere --output=~/surface --format npy")
    assert Path("surface/depth.npy").is_file()
    run("calibrate ~/sphere/light_directions.txt", input_error="sphere/light_directions.txt")
    # The weights are a name or a file.
    missing = run("infer ~/sphere --weights=~/none.safetensors --output=~/others", code=4).err
    assert str(capture.parent.absolute() / "none.safetensors") in missing
    assert not Path("~").exists()


@pytest.mark.skipif(os.name == "nt", reason="POSIX pipes")
@parametrize("closed", "stdout both")
def test_a_batch_is_finished_after_its_pipe_was_closed(closed, capture, make_capture):
    """`infer captures/* | head -1` and `infer captures/* 2>&1 | head -1` compute every capture."""
    make_capture("second")
    make_capture("third")
    Path("third/image3.png").write_bytes(b"no picture")
    read, write = os.pipe()
    os.close(read)
    words = f"-u -m splinecli infer {capture} third second --method ls"
    arguments = [sys.executable, *words.split()]
    done = subprocess.run(
        arguments, stdout=write, stderr=write if closed == "both" else subprocess.PIPE, text=True
    )
    os.close(write)
    assert done.returncode == 3
    assert names_in("out") == {"index.html", "second", "sphere"}
    if closed == "stdout":
        assert done.stderr.endswith("3 captures: 2 done, 1 failed; see out/index.html\n")


@parametrize("name", "infer info calibrate integrate evaluate prepare")
@parametrize(
    "wrong", ["nowhere", "--magic", "--output", ""], ids=lambda text: text or "no argument"
)
def test_a_failure_is_a_json_document(name, wrong, run):
    """A capture that cannot be read, an unknown option, an option without a value,
    and no argument.
    """
    missing = wrong == "nowhere"
    result = run(
        f"{name} --json {wrong} {'-o set' if missing and name == 'prepare' else ''}",
        code=3 if missing else 2,
    )
    document = result.json
    if name == "infer":
        (document,) = document
    if name == "infer" or (missing and name == "integrate"):
        check(document, "Failure")
    if name == "infer":
        assert document.pop("capture") == (wrong if missing else None)
    assert document == {
        "error": result.err.removeprefix("splinecli: ").rstrip("\n"),
        "exit_code": result.code,
    }
    assert result.err.count("\n") == 1
    assert ("nowhere" in result.err) == missing
    assert run(f"{name} --magic", code=2).out == ""


@parametrize(
    "command, skipped",
    """
evaluate | capture
prepare | source
""",
)
def test_a_subfolder_without_permission_is_skipped(
    command, skipped, make_capture, run_without_privileges
):
    for name in ("set/a", "set/b", "set/c"):
        make_capture(name)
    Path("set/b").chmod(0)
    extra = "--method ls --trials 1 --n-lights 4" if command == "evaluate" else ""
    result = run_without_privileges(f"{command} set -o out --json {extra}", code=3)
    Path("set/b").chmod(0o755)
    (entry,) = result.json["skipped"]
    assert Path(entry[skipped]).name == "b" and entry["reason"] in result.err
    assert "set/b: the folder cannot be read (Permission denied)" in entry["reason"]


@parametrize(
    "variables, expected",
    [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active"), ({"GOMP_SPINCOUNT": "9"}, None)],
)
def test_waiting_threads_sleep_unless_the_user_says_otherwise(variables, expected):
    script = "import os; from splinecli.cli.main import main; main(['--version']); "
    script += "print(os.environ.get('OMP_WAIT_POLICY'))"
    clean = {
        name: value
        for name, value in os.environ.items()
        if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
    }
    done = run_python(script, check=True, env={**clean, **variables})
    assert done.stdout.splitlines()[-1] == str(expected)


@parametrize(
    "error, expected",
    [
        (
            PermissionError(errno.EACCES, "Permission denied", "lights.txt"),
            ("lights.txt: cannot be read", 3),
        ),
        (OSError(errno.EIO, "Input/output error"), ("cannot be read (Input/output error)", 3)),
        (OSError(errno.ENOSPC, "No space left on device", "out"), ("out: cannot be written", 5)),
    ],
)
def test_an_error_of_the_system_that_no_command_expected(error, expected):
    message, code = explain(error)
    assert message.startswith(expected[0]) and code == expected[1]


def test_a_line_every_half_minute_off_a_terminal(capsys, monkeypatch):
    now = 0.0
    monkeypatch.setattr(console, "LINE_SECONDS", 30)
    monkeypatch.setattr(time, "monotonic", lambda: now)
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
    with Messages(quiet=False).progress("cat: aligning", 100) as advance:
        now += 40
        advance(2)  # too early for an estimate of the time
    assert capsys.readouterr().err == "cat: aligning: 2 %\n"
    with Messages(quiet=True).progress("cat: estimating", 1) as advance:
        now += 100
        advance(0.5)
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(os.name == "nt", reason="POSIX terminals")
def test_the_bar_moves_at_least_twice_a_second_on_a_terminal():
    """A bar that is advanced every tenth of a second shows at least four percentages in 2.5
    seconds.
    """
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


def test_messages_name_what_was_meant(run, tmp_path):
    run("infer none --maps albedos", usage_error="Did you mean albedo?")
    run("infer none --maps reliefs", usage_error="Did you mean relief?")
    run("infer none --light-frame xleft", usage_error="Did you mean x-left?")
    run("infer none --first-light uper-left", usage_error="Did you mean upper-left?")
    run("infer none --lights estimat", input_error="Did you mean estimate?")
    assert "waiting" not in run("watch nowhere", input_error="nowhere").err
    put(tmp_path / "a.txt", "no normals")
    run(f"integrate {tmp_path / 'a.txt'}", input_error="found neither .npy, .mat, PNG, TIFF,")
