"""Records: frozen options, settings and documents, declared once and validated on construction.

A field's annotation defines its type and its range (`msgspec.Meta`). A field that is an option of a
command has an `option` as its default, or an annotation with an `Option`. The command line, the
checks, `as_dict`, `from_dict`, the JSON Schema and the man pages are derived from these
declarations.
"""

from __future__ import annotations

import re
import types
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from functools import lru_cache, partial
from math import isfinite
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from msgspec import Meta, Struct, StructMeta, ValidationError, convert, to_builtins
from msgspec.structs import fields, replace

from splinecli.errors import SplinecliError, UsageError, check_one_of, did_you_mean

ARGUMENTS, NEAR, SPECIAL = "Arguments", "Near lamps and perspective", "Special cases"
# The panels of the help, in order
PANELS = [
    *(ARGUMENTS, "Captures", "Input", "Settings", "Pixels", "Scenes", "Length", "Lights"),
    *("Light intensities", "Method", "Output", "Speed", NEAR, "Processes and machines", SPECIAL),
]
PATH = object()
FileName = Annotated[str, PATH]  # a path that is stored as text
Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
BelowOne = Annotated[float, Meta(ge=0, lt=1)]
Conflicts = tuple[tuple[str, str, str], ...]
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]


@dataclass(frozen=True)
class Option:
    """How a field is given on the command line.

    Args:
        panel: one of PANELS.
        metavar: placeholder for the value; "" for a flag or a choice.
        default: description of a default of None, for the help.
        names: names such as "--output -o"; by default `--field-name`.
        complete: the values for shell completion, or a function that returns them.
        parse: converts a text to the field's value. For an option that may be repeated (a tuple
            without items), it converts each text.
        items: the names allowed in a list "a,b".
        value: the default of the field, or NODEFAULT.
    """

    panel: str
    help: str
    metavar: str = ""
    default: str | None = None
    names: str = ""
    complete: Callable[..., list[str]] | Collection[str] | None = None
    parse: Callable[[str], Any] | None = None
    items: Collection[str] = ()
    value: Any = None

    @property
    def is_argument(self) -> bool:
        """Whether it is a positional argument."""
        return self.panel == ARGUMENTS

    def value_of(self, given: Any, title: str) -> Any:
        """Convert Typer's value to the field's value. Raises UsageError."""
        if self.items:
            names = tuple(item.strip() for item in given.split(",") if item.strip())
            for name in names:
                if name not in self.items:
                    problem = (
                        f"{title} contains {name!r}; expected a list of {', '.join(self.items)}"
                    )
                    raise UsageError(problem, hint=did_you_mean(name, self.items))
            if not names:
                raise UsageError(f"{title} is empty; expected a list of {', '.join(self.items)}")
            return names
        parse = self.parse or (lambda value: value)
        return tuple(map(parse, given)) if isinstance(given, list) else parse(given)


# Typed as Any, so that they can be defaults of fields. A flag is off by default
option: Any = Option
flag: Any = partial(Option, value=False)


class _RecordMeta(StructMeta):
    """Replaces the options in a record's body with the defaults of the fields."""

    def __new__(
        cls, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **settings: Any
    ) -> Any:
        options = {key: value for key, value in namespace.items() if isinstance(value, Option)}
        made: Any = super().__new__(
            cls,
            name,
            bases,
            namespace | {key: each.value for key, each in options.items()},
            **settings,
        )
        made.OPTIONS = getattr(made, "OPTIONS", {}) | options
        return made


class Record(Struct, metaclass=_RecordMeta, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A frozen record of options with validated fields.

    Raises UsageError for an invalid value, or if two options cannot be used together.
    """

    CONFLICTS: ClassVar[Conflicts] = ()
    """Pairs of fields of which only one may differ from its default, each with a hint.

    Instead of a field's name, NAME=VALUE stands for the field with this value.
    """

    def __post_init__(self) -> None:
        titles = {}
        for name, kind in field_types(type(self)).items():
            option, value = option_of(kind), getattr(self, name)
            title = f"option {name!r}" if option is None else long_name(name, option)
            converted(kind, value, title, UsageError)
            if option is not None:
                for item in value if option.items else ():
                    check_one_of(name.removesuffix("s"), item, option.items)
                titles[name] = title
        for *pair, hint in self.CONFLICTS:
            if all(map(self.has, pair)):
                first, second = (
                    " ".join([titles[name], *value])
                    for name, *value in (e.split("=") for e in pair)
                )
                raise UsageError(f"{first} and {second} cannot be used together", hint=hint)

    def has(self, given: str) -> bool:
        """Return whether a field differs from its default, or for NAME=VALUE has this value."""
        name, equals, value = given.partition("=")
        default = {field.name: field.default for field in fields(self)}[name]
        return bool(getattr(self, name) == value if equals else getattr(self, name) != default)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with new values for some fields."""
        return replace(self, **changes)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        values: dict[str, Any] = to_builtins(self, enc_hook=str)
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return a record from the result of `as_dict`.

        Raises UsageError for an unknown name or an invalid value.
        """
        return cls(**settings(cls, values, "option", UsageError))

    @classmethod
    def from_arguments(cls, given: dict[str, Any]) -> Self:
        """Return the record of its command-line values, which are removed from `given`.

        Raises UsageError.
        """
        values: dict[str, Any] = {}
        for name, kind in field_types(cls).items():
            if (option := option_of(kind)) is not None:
                if (value := given.pop(name)) is not None:
                    values[name] = _from_typer(kind, option, value, long_name(name, option))
                elif option.is_argument:
                    values[name] = ()
            elif isinstance(kind, type) and issubclass(kind, Record):
                values[name] = kind.from_arguments(given)
        return cls(**values)


def _from_typer(kind: Any, option: Option, given: Any, title: str) -> Any:
    """Convert a value from Typer to the type of the field. Raises UsageError."""
    value = option.value_of(given, title)
    if (number := number_of(kind)) is not None and option.parse is None:
        one: Any = Annotated[number, limits(kind)]
        items = [converted(one, item, title, UsageError, strict=False) for item in _each(value)]
        value = tuple(items) if isinstance(value, tuple) else items[0]
    is_name = is_file_name(kind)
    is_file = (is_name or isinstance(value, Path)) and not option.is_argument
    if is_file and str(value).startswith("-"):
        raise UsageError(
            f"{title} needs a file or folder, found {value}",
            hint="Write the file or folder after the option",
        )
    return str(value) if is_name else value


@lru_cache
def field_types(record: type) -> dict[str, Any]:
    """Return the annotation of each field of a record or dataclass."""
    hints = get_type_hints(record, include_extras=True)
    names = record.__dataclass_fields__ if is_dataclass(record) else record.__struct_fields__  # type: ignore[attr-defined]
    options = getattr(record, "OPTIONS", {})
    kinds = {name: hints[name] for name in names}
    return {n: Annotated[kind, options[n]] if n in options else kind for n, kind in kinds.items()}


def settings(
    record: type, values: Mapping[str, Any], noun: str, error: type[SplinecliError]
) -> dict[str, Any]:
    """Convert values from JSON or TOML to the types of the fields of a record or dataclass.

    Raises the given error for an unknown name or an invalid value. In its message, `noun` precedes
    the name.
    """
    kinds = field_types(record)
    for name in values:
        if name not in kinds:
            problem = f"unknown {noun} {name!r}, expected one of {', '.join(sorted(kinds))}"
            raise error(problem, hint=did_you_mean(name, kinds))
    return {
        name: converted(kinds[name], value, f"{noun} {name!r}", error)
        for name, value in values.items()
    }


def converted(
    kind: Any, value: Any, title: str, error: type[SplinecliError], *, strict: bool = True
) -> Any:
    """Convert a value to a type, for example a list to a tuple.

    Raises the given error, whose message starts with the title. Unless `strict` is set, numbers may
    be given as text.
    """
    if isinstance(kind, type) and is_dataclass(kind) and isinstance(value, kind):
        return value
    with suppress(ValidationError):
        found = convert(value, kind, strict=strict)
        items = found.values() if isinstance(found, dict) else _each(found)
        if all(isfinite(item) for item in items if isinstance(item, float)):
            return found
    problem = f"{title} is {value!r}; expected {kind_in_words(kind)}"
    raise error(problem, hint=did_you_mean(value, choices_of(kind)))


def choices_of(kind: Any) -> tuple[str, ...]:
    """Return the names that a field may have, or an empty tuple if any value is allowed."""
    bare = plain(kind)
    parts = (bare, *get_args(bare))
    return next((get_args(part) for part in parts if get_origin(part) is Literal), ())


def option_of(kind: Any) -> Option | None:
    """Return how a field with this annotation is given on the command line."""
    metadata = getattr(kind, "__metadata__", ())
    return next((item for item in metadata if isinstance(item, Option)), None)


def long_name(name: str, option: Option) -> str:
    """Return the long name of an option, such as --n-lights, or the name of an argument."""
    if option.is_argument:
        return option.metavar
    return re.split("[ /]", option.names)[0] or f"--{name.replace('_', '-')}"


def limits(kind: Any) -> Meta:
    """Return the range of the numbers of a type."""
    return next((item for item in _metadata(kind) if isinstance(item, Meta)), Meta())


def _metadata(kind: Any) -> Iterator[Any]:
    yield from getattr(kind, "__metadata__", ())
    for part in get_args(kind):
        yield from _metadata(part)


def is_file_name(kind: Any) -> bool:
    """Return whether a field with this annotation stores a path as text."""
    return PATH in _metadata(kind)


def plain(kind: Any) -> Any:
    """Return a type without annotations, with Path for a stored path and list for a tuple."""
    if get_origin(kind) is Annotated:
        return Path if PATH in kind.__metadata__ else plain(get_args(kind)[0])
    if get_origin(kind) in (Union, types.UnionType):
        return Union[tuple(map(plain, get_args(kind)))]  # noqa: UP007 - of a tuple
    return list[plain(get_args(kind)[0])] if get_origin(kind) is tuple else kind  # type: ignore[misc]


def kind_in_words(kind: Any) -> str:
    """Return a description of the values of a type, such as "a number from 0 to 1"."""
    bare = plain(kind)
    if get_origin(bare) is Union:
        bare = get_args(bare)[0]
    if get_origin(bare) is Literal:
        names = list(map(repr, get_args(bare)))
        return " or ".join(names) if len(names) < 3 else f"one of {', '.join(names)}"
    if get_origin(bare) in (list, dict):
        whole = (
            "list in which each item" if get_origin(bare) is list else "table in which each value"
        )
        return f"a {whole} is {kind_in_words(Annotated[get_args(bare)[-1], limits(kind)])}"
    if bare not in (int, float):
        return {bool: "true or false", str: "a string", Path: "a string"}.get(
            bare, "a table of settings"
        )
    words, given = "a whole number" if bare is int else "a number", limits(kind)
    lower = "of at least" if given.le is None and given.lt is None else "from"
    for bound, word in (
        (given.ge, lower),
        (given.gt, "above"),
        (given.le, "to"),
        (given.lt, "to below"),
    ):
        words += "" if bound is None else f" {word} {bound:.10g}"
    return words if given.multiple_of is None else f"{words}, a multiple of {given.multiple_of}"


def _each(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def number_of(kind: Any) -> type | None:
    """Return int or float for numbers, optional numbers and lists of numbers; None for other
    types.
    """
    found = plain(kind)
    while get_args(found) and get_origin(found) is not Literal:
        found = get_args(found)[0]
    return found if found in (int, float) else None


def complete_list(items: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a function that completes a list "a,b" with each name that may follow."""

    def complete(incomplete: str) -> list[str]:
        *typed, _ = incomplete.split(",")
        return [",".join([*typed, name]) for name in items if name not in typed]

    return complete


def listed(names: Iterable[str]) -> str:
    """Return the names as in "a, b or c"."""
    *most, last = names
    return f"{', '.join(most)} or {last}" if most else last
