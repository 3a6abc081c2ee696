"""The names and intervals in the help of `train` are those of the code, and load without PyTorch."""

from __future__ import annotations

import subprocess
import sys

from splinecli.training import defaults, loop
from splinecli.training.config import PRESETS


def test_the_names_of_presets_are_those_of_the_presets() -> None:
    assert tuple(PRESETS) == defaults.PRESET_NAMES
    assert defaults.DEFAULT_PRESET in PRESETS


def test_the_loop_keeps_the_intervals_that_the_help_gives() -> None:
    assert loop.CHECKPOINT_SECONDS == defaults.CHECKPOINT_SECONDS
    assert loop.REPORT_STEPS == defaults.REPORT_STEPS


def test_they_load_without_pytorch() -> None:
    code = "import sys, splinecli.training.defaults; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
