"""How often a command opens each photograph."""

import os
import sys
from collections import Counter
from pathlib import Path

MEDALLION = Path(__file__).parents[2] / "examples" / "medallion"


def test_each_image_is_opened_at_most_three_times(run, tmp_path):
    """Once for its facts, once for its pixels, and once for the colours of the albedo map."""
    opened = Counter()
    counting = [True]

    def count(event, arguments):
        if counting and event == "open" and isinstance(arguments[0], str | os.PathLike):
            opened[Path(arguments[0])] += 1

    sys.addaudithook(count)  # for good, so that it has a switch
    command = ("infer", MEDALLION, "--method", "ls", "--n-lights", 5, "--maps", "albedo", "-o", tmp_path)
    try:
        assert run(*command).code == 0
    finally:
        counting.clear()
    counts = sorted(opened[path] for path in MEDALLION.glob("[0-9]*.png"))
    assert counts == 5 * [1] + 5 * [3]
