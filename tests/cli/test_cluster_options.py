"""Options of workers and clusters that are refused before anything is computed."""

import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--workers", "0"), "--workers is '0'; expected a number from 1, or auto"),
        (("--workers", "many"), "--workers is 'many'; expected a number from 1, or auto"),
        (("--workers", "2", "--cluster", "tcp://a:1"), "--workers and --cluster contradict each other"),
        (("--shard", "3/2"), "--shard is 3/2; expected I/N with I from 1 to N"),
        (("--shard", "half"), "--shard is 'half'; expected I/N"),
        (("--cluster", "none.json"), "--cluster is none.json; expected an address such as tcp://scheduler:8786"),
    ],
)
def test_refusals(arguments, message, capture, make_capture, run):
    if "--cluster" in arguments:
        pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    make_capture("second")
    result = run("infer", capture, "second", "--method", "ls", *arguments)
    assert (result.code, result.out, result.err.count("\n")) == (2, "", 1)
    assert message in result.err
    assert not Path("out").exists()


@pytest.mark.parametrize("arguments", [("--workers", "2"), ("--cluster", "tcp://127.0.0.1:1")])
def test_without_dask(arguments, capture, make_capture, run, monkeypatch):
    make_capture("second")
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = run("infer", capture, "second", "--method", "ls", *arguments)
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert "Run pip install 'splinecli[cluster]'" in result.err
    assert not Path("out").exists()
    # One capture needs no further process.
    if "--workers" in arguments:
        assert run("infer", capture, "--method", "ls", *arguments).code == 0
