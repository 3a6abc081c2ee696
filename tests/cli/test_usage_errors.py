"""Usage errors: each message names what was found and what was expected; those of the parser also the help."""

import sys
from pathlib import Path

import pytest

CASES = {
    "inferr X": "no command 'inferr'. Did you mean 'infer' or 'info'? See 'splinecli --help'.",
    "magic": "no command 'magic'. See 'splinecli --help'.",
    "": "a command is missing. See 'splinecli --help'.",
    "infer": "CAPTURE is missing. See 'splinecli infer --help'.",
    "train": "--output is missing. See 'splinecli train --help'.",
    "infer X --lights": "--lights needs a value. See 'splinecli infer --help'.",
    "infer X --html=3": "--html takes no value. See 'splinecli infer --help'.",
    "info a b": "unexpected arguments: b. See 'splinecli info --help'.",
    "infer X -z": "no option -z. See 'splinecli infer --help'.",
    "infer X --msk": "no option --msk. Did you mean --auto-mask, --maps or --mask? See 'splinecli infer --help'.",
    "prepare -o s --lights 20": "no option --lights. Did you mean --n-lights? See 'splinecli prepare --help'.",
    "infer X --n-lights abc": "--n-lights is 'abc'; expected a whole number of at least 3.",
    "prepare -o s --n-lights 20.5": "--n-lights is '20.5'; expected a whole number of at least 16.",
    "prepare -o s --n-lights 4": "--n-lights is '4'; expected a whole number of at least 16.",
    "evaluate X --light-noise-deg 1 --light-noise-deg x": "--light-noise-deg is 'x'; expected a number of at least 0.",
    "infer X --stiffness 2": "--stiffness is now --discontinuity. See 'splinecli infer --help'.",
    "info X --lights-format azel": "--lights-format is now --light-format. See 'splinecli info --help'.",
    "info X --light-frame exchanged": "--light-frame is 'exchanged'; exchanged is now swap-xy.",
    "infer X --device tpu": "--device is 'tpu'; expected one of 'auto', 'cpu', 'cuda'.",
}


def test_usage_errors(run):
    for arguments, message in CASES.items():
        assert run(*arguments.split()) == (2, "", f"splinecli: {message}\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--workers", "0"), "--workers is '0'; expected a number of at least 1, or auto"),
        (("--workers", "many"), "--workers is 'many'; expected a number of at least 1, or auto"),
        (("--workers", "2", "--cluster", "tcp://a:1"), "--workers and --cluster contradict each other"),
        (("--shard", "3/2"), "--shard is 3/2; expected I/N with I from 1 to N"),
        (("--shard", "half"), "--shard is 'half'; expected I/N"),
        (("--cluster", "none.json"), "--cluster is none.json; expected an address such as tcp://scheduler:8786"),
    ],
)
def test_refused_options_of_clusters(arguments, message, capture, make_capture, run):
    if "--cluster" in arguments:
        pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    make_capture("second")
    result = run("infer", capture, "second", "--method", "ls", *arguments)
    assert (result.code, result.out, result.err.count("\n")) == (2, "", 1)
    assert message in result.err
    assert not Path("out").exists()


@pytest.mark.parametrize("option", ["--crosstalk", "--mask", "--output"])
def test_an_option_is_not_the_value_of_the_one_before(option, capture, run):
    result = run("infer", capture, "--lights-in-channels", option, "--strict")
    assert result.code == 2
    assert f"{option} needs a file or folder, found --strict. Name it after the option." in result.err


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
