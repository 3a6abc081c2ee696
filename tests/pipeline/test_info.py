"""The options of `info`, and the lines of its report."""

from __future__ import annotations

from splinecli.pipeline.info import ORIGINS


def test_every_origin_of_a_white_level_has_words() -> None:
    from typing import get_args

    from splinecli.capture.restore.white_level import Origin

    assert ORIGINS.keys() == set(get_args(Origin))
