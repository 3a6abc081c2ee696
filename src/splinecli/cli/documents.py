"""The JSON documents of commands on stdout."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from splinecli.cli.failures import explain


def error_document(error: Exception) -> dict[str, Any]:
    """Return {"error", "exit_code"}, which stand in place of a report."""
    message, exit_code = explain(error)
    return {"error": message, "exit_code": exit_code}


@contextmanager
def printed_documents(*, as_list: bool, as_lines: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a function that prints a document of `infer`, which has one for each capture, as soon as that ends.

    Each is a line, or an item of one list. The last is that of an error that ends the command.
    """
    is_empty = True

    def add(document: dict[str, Any]) -> None:
        nonlocal is_empty
        if as_lines:
            print(json.dumps(document), flush=True)
        elif as_list:
            item = textwrap.indent(json.dumps(document, indent=2), "  ")
            print("[\n" if is_empty else ",\n", item, sep="", end="", flush=True)
        is_empty = False

    try:
        yield add
    except Exception as error:
        add({"capture": None, **error_document(error)})
        raise
    finally:
        if as_list and not as_lines:
            print("[]" if is_empty else "\n]")
