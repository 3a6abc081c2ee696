"""The documents of `infer` on stdout: one for each capture, as soon as the capture ends."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from splinecli.cli.failures import batch_error_document


class Documents:
    """Receives documents and prints none of them."""

    def add(self, document: dict[str, Any]) -> None:
        """Receive a document."""

    def end(self) -> None:
        """Receive no further documents."""


class JsonLines(Documents):
    """Prints each document in one line."""

    def add(self, document: dict[str, Any]) -> None:
        print(json.dumps(document), flush=True)


class JsonList(Documents):
    """Prints the documents as the items of one list."""

    def __init__(self) -> None:
        self._is_empty = True

    def add(self, document: dict[str, Any]) -> None:
        item = textwrap.indent(json.dumps(document, indent=2), "  ")
        print("[\n" if self._is_empty else ",\n", item, sep="", end="", flush=True)
        self._is_empty = False

    def end(self) -> None:
        print("[]" if self._is_empty else "\n]")


@contextmanager
def printed_documents(*, as_list: bool, as_lines: bool) -> Iterator[Documents]:
    """Yield the printer of documents. The last document is that of an error that ends the command."""
    documents = JsonLines() if as_lines else JsonList() if as_list else Documents()
    try:
        yield documents
    except Exception as error:
        documents.add(batch_error_document(error))
        raise
    finally:
        documents.end()
