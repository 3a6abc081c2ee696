"""The errors that splinecli raises on purpose. Each has an exit code, and a hint with a remedy."""

from collections.abc import Collection
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any


def printable(text: object) -> str:
    """Return the text on one line, with escapes such as \\n for non-printable characters.

    File names may contain any character, including control sequences that move the cursor or
    imitate a line.
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode()
        for c in str(text)
    )


class SplinecliError(Exception):
    """A failure that is explained by a single message: "PATH:LINE: PROBLEM. HINT.".

    Args:
        problem: the value found and the value expected, as one sentence without the final full
            stop.
        path: the file or folder that causes the failure, if any.
        line: the line in that file, counted from 1, if any.
        hint: the remedy, as one sentence without the final full stop, or a question.

    Examples:
        >>> from splinecli.errors import SplinecliError
        >>> from splinecli.estimate.methods import make_estimator
        >>> try:
        ...     make_estimator("photoshop")
        ... except SplinecliError as error:
        ...     print(error.exit_code, error.problem.partition(";")[0])
        2 no method named 'photoshop'
    """

    exit_code = 1

    def __init__(
        self,
        problem: str,
        path: str | Path | None = None,
        *,
        line: int | None = None,
        hint: str | None = None,
    ) -> None:
        self.problem = problem
        self.path = None if path is None else Path(path)
        self.line = line
        self.hint = hint
        place = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        end = "" if (hint or "").endswith("?") else "."
        super().__init__(printable(f"{place}{problem}." + (f" {hint}{end}" if hint else "")))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the error for another process."""
        return partial(type(self), path=self.path, line=self.line, hint=self.hint), (self.problem,)


class UsageError(SplinecliError):
    """The options or arguments are not valid or cannot be used together (exit code 2)."""

    exit_code = 2


class InputError(SplinecliError):
    """The input data are missing, damaged or inconsistent (exit code 3)."""

    exit_code = 3


class ModelError(SplinecliError):
    """Weights, a checkpoint or a configuration cannot be used (exit code 4)."""

    exit_code = 4


class OutputError(SplinecliError):
    """An output cannot be written (exit code 5)."""

    exit_code = 5


def check_one_of(kind: str, value: str, allowed: Collection[str]) -> None:
    """Raise UsageError for a value that is not allowed."""
    if value not in allowed:
        problem = f"no {kind} named {value!r}; expected one of {', '.join(allowed)}"
        raise UsageError(problem, hint=did_you_mean(value, allowed))


def did_you_mean(value: object, names: Collection[str]) -> str | None:
    """Return the hint "Did you mean NAME?" if a name is similar to the value."""
    found = get_close_matches(str(value).lower(), names, 1, cutoff=0.6)
    return f"Did you mean {found[0]}?" if found else None
