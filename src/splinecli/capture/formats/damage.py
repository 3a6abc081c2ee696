"""What readers of files raise for damaged ones, as errors that name the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splinecli.errors import InputError, SplinecliError
from splinecli.system.memory import is_out_of_memory

DAMAGED, COPY_AGAIN = "the image is damaged and cannot be read", "Copy or export it again"
"""Problem and hint for a damaged image."""


@contextmanager
def damage_as_input_error(path: Path, problem: str, hint: str | None = None) -> Iterator[None]:
    """Turn whatever a reader raises for a damaged file, one of a dozen types, into an InputError."""
    try:
        yield
    except SplinecliError:
        raise
    except PermissionError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise InputError(problem, path=path, hint=hint) from error
