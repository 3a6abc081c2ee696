"""Errors of the parser: each message names what was found, what was expected, and the help of the command."""

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
    "infer X --n-lights abc": "--n-lights is 'abc'; expected a whole number from 3. See 'splinecli infer --help'.",
    "prepare -o s --n-lights 20.5": (
        "--n-lights is '20.5'; expected a whole number from 16. See 'splinecli prepare --help'."
    ),
    "prepare -o s --n-lights 4": "--n-lights is 4; expected at least 16. See 'splinecli prepare --help'.",
    "evaluate X --light-noise-deg 1 --light-noise-deg x": (
        "--light-noise-deg is 'x'; expected a number from 0. See 'splinecli evaluate --help'."
    ),
    "infer X --device tpu": "--device is 'tpu'; expected one of auto, cpu, cuda. See 'splinecli infer --help'.",
}


@pytest.mark.parametrize("arguments", CASES)
def test_usage_errors(arguments, run):
    result = run(*arguments.split())
    assert (result.code, result.out, result.err) == (2, "", f"splinecli: {CASES[arguments]}\n")
