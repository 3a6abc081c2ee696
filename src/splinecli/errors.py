"""The one family of errors that splinecli raises on purpose. Each carries its exit code and its remedy."""

from __future__ import annotations

from pathlib import Path


class SplinecliError(Exception):
    """A failure with one clear message.

    Args:
        problem: what was found and what was expected, one sentence without a final full stop.
        path: the file or folder at fault, where there is one.
        line: the one-based line of that file, where there is one.
        hint: the way out, one sentence without a final full stop.
    """

    exit_code = 1

    def __init__(
        self,
        problem: str,
        *,
        path: str | Path | None = None,
        line: int | None = None,
        hint: str | None = None,
    ) -> None:
        self.problem = problem
        self.path = None if path is None else Path(path)
        self.line = line
        self.hint = hint
        place = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(f"{place}{problem}." + (f" {hint}." if hint else ""))


class UsageError(SplinecliError):
    """The command line or an API call cannot be meant this way (exit code 2)."""

    exit_code = 2


class InputError(SplinecliError):
    """The input data are missing, damaged or do not fit together (exit code 3)."""

    exit_code = 3


class ModelError(SplinecliError):
    """Weights, a checkpoint or a configuration cannot be used (exit code 4)."""

    exit_code = 4


class OutputError(SplinecliError):
    """An output cannot be written (exit code 5)."""

    exit_code = 5
