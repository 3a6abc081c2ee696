"""Build Typer commands from functions that take records, with an option for each field of a record."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterator
from importlib import import_module
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from msgspec import NODEFAULT
from msgspec.structs import fields
from typer import Argument, Context
from typer import Option as TyperOption

from splinecli.records import PANELS, Option, Record, complete_list, field_types, long_name, number_of, option_of, plain


def command(function: Callable[..., int | None], module: str) -> Callable[..., int | None]:
    """Return a function for Typer that accepts the options of a function's records, and calls it with the records.

    The module defines the records. It is imported here, so that it does not slow down the help of other commands.
    """
    records: dict[str, type[Record]] = {}
    parameters = []
    for name, kind in get_type_hints(function, localns=vars(import_module(module))).items():
        if kind is Context:
            parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=kind))
        elif name != "return":
            records[name] = kind
    options = [option for record in records.values() for option in _options(record)]
    options.sort(key=lambda option: PANELS.index(option[1].panel))
    parameters += [_parameter(*option) for option in options]

    def call(**given: Any) -> int | None:
        made = {name: record.from_arguments(given) for name, record in records.items()}
        return function(**given, **made)

    call.__name__, call.__doc__ = function.__name__, help_of(function)
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return call


def help_of(function: Callable[..., object]) -> str:
    """Return the text of a function's docstring, with a line for each paragraph."""
    paragraphs = inspect.cleandoc(function.__doc__ or "").split("\n\n")
    return "\n\n".join(" ".join(text.split()) for text in paragraphs)


def _options(record: type[Record]) -> Iterator[tuple[str, Option, Any, Any]]:
    """Yield the name, option, annotation and default of each field that has an option."""
    defaults = {field.name: field.default for field in fields(record)}
    for name, kind in field_types(record).items():
        option = option_of(kind)
        if option is not None:
            yield name, option, kind, defaults[name]
        elif isinstance(kind, type) and issubclass(kind, Record):
            yield from _options(kind)


def _parameter(name: str, option: Option, kind: Any, default: Any) -> inspect.Parameter:
    """Return Typer's parameter for a field. Record.from_arguments converts texts to numbers and lists."""
    typed, metavar, complete = plain(kind), option.metavar, option.complete
    choices = next((get_args(part) for part in (typed, *get_args(typed)) if get_origin(part) is Literal), ())
    if choices:
        metavar, complete = "|".join(choices), choices
    elif option.items:
        complete = complete_list(option.items)
    if choices or option.items or option.parse is not None or number_of(kind) is not None:
        typed = list[str] if option.repeated else str
    if default is NODEFAULT:
        default = inspect.Parameter.empty
    elif isinstance(default, tuple):
        default = (list(map(str, default)) if option.repeated else ",".join(default)) or None
    elif default is not None and not isinstance(default, bool):
        default = str(default)
    if default is None:
        typed = typed | None
    if complete is not None and not callable(complete):
        complete = _offer(complete)
    # By default, Typer refuses a path without permission. One such capture would then end a batch.
    common: dict[str, Any] = {"help": option.help, "autocompletion": complete, "readable": False}
    info: Any
    if option.is_argument:
        info = Argument(metavar=metavar, show_default=False, **common)
    else:
        names = option.names or (long_name(name, option),)
        shown = True if option.default is None else option.default
        info = TyperOption(*names, metavar=metavar, show_default=shown, rich_help_panel=option.panel, **common)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[typed, info])


def _offer(names: Collection[str]) -> Callable[[], list[str]]:
    return lambda: list(names)
