"""Options of `evaluate` in Python, where no command line has checked their ranges."""

from __future__ import annotations

from typing import Any

import pytest

from splinecli.errors import UsageError
from splinecli.pipeline.evaluate import EvaluateOptions


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"trials": 0}, "--trials is 0; expected at least 1."),
        ({"jobs": 0}, "--jobs is 0; expected at least 1."),
    ],
)
def test_zero_is_not_the_default(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as raised:
        EvaluateOptions(**options)
    assert str(raised.value) == message
