"""`splinecli watch`: captures that arrive are computed once, and a signal ends it."""

import json
import shutil
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from splinecli.cli import infer as watch


def test_captures_are_computed_as_they_arrive_and_only_once(run, capture, make_capture, monkeypatch) -> None:
    """Something happens at each look at the folder; then Ctrl-C."""
    parts = Path("parts")
    (parts / "bad").mkdir(parents=True)
    (parts / "bad/done").touch()

    def look(steps: list) -> None:
        def sleep(seconds: float) -> None:
            if not steps:
                raise KeyboardInterrupt
            steps.pop(0)()

        monkeypatch.setattr(watch.time, "sleep", sleep)

    # Meanwhile, the folder is away for two looks.
    steps = [lambda: parts.rename("away"), lambda: None, lambda: Path("away").rename(parts)]
    copy = partial(shutil.copytree, capture, parts / "-first 1")
    look([*steps, copy, lambda: (parts / "-first 1/done").touch()])
    command = ("watch", parts, "--marker", "done", "--", "--method", "ls", "--jsonl", "-o", "out")
    result = run(*command)
    assert result.code == 130
    failed, again, done = map(json.loads, result.out.splitlines())
    assert (failed["capture"], failed["exit_code"]) == ("bad", 3) and again == failed
    assert result.err.count("parts: the folder cannot be read (No such file or directory). Waiting for it.") == 1
    assert "parts: the folder is there again" in result.err
    assert (done["capture"], done["method"]) == ("-first 1", "ls")
    before = Path("out/-first 1/report.json").stat().st_mtime_ns
    look([])
    assert "out/-first 1: already done, skipped" in run(*command).err
    assert Path("out/-first 1/report.json").stat().st_mtime_ns == before


def test_an_interruption_of_a_capture_ends_it(run, capture, monkeypatch) -> None:
    Path("parts").mkdir()
    capture.rename("parts/sphere")
    monkeypatch.setattr("splinecli.pipeline.batch.run_member", Mock(side_effect=KeyboardInterrupt))
    result = run("watch", "parts", "--settle", 0, "--", "--method", "ls")
    assert result.code == 130 and "interrupted" in result.err


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--json",), "--json prints one list at the end, and watch has none"),
        (("--shard", "1/2"), "--shard splits a list of captures"),
        (("other",), "found other after the dashes, expected options of infer"),
        (("-o", "sphere/../sphere"), "the results would be among the captures"),
        (("--methd", "ls"), "no option --methd"),
        (("--method", "lss"), "no method named 'lss'"),
        (("--overwrite", "--update"), "contradict each other"),
    ],
)
def test_wrong_options_are_refused(run, capture, options: tuple[str, ...], problem: str) -> None:
    result = run("watch", capture, "--settle", 0, "--", *options)
    assert result.code == 2 and problem in result.err


def test_no_folder(run, capture) -> None:
    result = run("watch", "nowhere")
    assert result.code == 3 and "nowhere: the folder cannot be read" in result.err
