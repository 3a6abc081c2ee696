"""The records of options, built from the arguments of a command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Record = TypeVar("Record", bound=DataclassInstance)


def record_from(record: type[Record], arguments: Mapping[str, Any], **values: Any) -> Record:
    """Build a record of options from the arguments of a command that have the names of its fields.

    Args:
        record: a frozen dataclass.
        arguments: of the command, such as its `locals()`. A choice becomes its value, a list a tuple, and a path text
            if the field holds no path.
        values: of fields that need more than this, in place of the arguments.

    Raises:
        UsageError: the record refuses a value.
    """
    given = {
        field.name: _value(arguments[field.name], str(field.type))
        for field in fields(record)
        if field.name in arguments
    }
    return record(**given | values)


def _value(value: Any, kind: str) -> Any:
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, list):
        return tuple(value)
    return str(value) if isinstance(value, Path) and "Path" not in kind else value
