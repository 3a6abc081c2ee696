"""Errors as one message and an exit code."""

from __future__ import annotations

import typer

from splinecli.cli.usage_errors import usage_message
from splinecli.errors import OutputError, SplinecliError
from splinecli.system.memory import is_out_of_memory

USAGE = 2
NO_MEMORY = "there is not enough memory. Close other programs, or use smaller images."
# Typer carries its own copy of click, in a place that changes with the version. This is click's base of usage errors.
ParserError: type[Exception] = typer.BadParameter.__mro__[1]  # for arguments that it cannot use


def explain(error: Exception) -> tuple[str, int]:
    """Return the message of an error that ends a command, and its exit code."""
    if isinstance(error, SplinecliError):
        return str(error), error.exit_code
    if isinstance(error, ParserError):
        return usage_message(error), USAGE
    if is_out_of_memory(error):
        return NO_MEMORY, SplinecliError.exit_code
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}cannot be read or written ({error.strerror}).", OutputError.exit_code
    return "this is a defect of splinecli; please report it with the lines above.", SplinecliError.exit_code


def is_defect(error: Exception) -> bool:
    """Return whether splinecli did not expect the error."""
    return not isinstance(error, SplinecliError | ParserError | OSError) and not is_out_of_memory(error)
