"""Read and write splinecli.toml, the file in a capture's folder with options for reading it."""

from __future__ import annotations

import json
import tomllib
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from msgspec.structs import fields

from splinecli.capture.files import find_named
from splinecli.errors import InputError, UsageError, did_you_mean
from splinecli.records import base as records
from splinecli.system.files import resolve

SETTINGS = "splinecli.toml"
CORRECT = "Correct the line, or remove it"
_WORDS = {"lights": ("estimate",), "intensities": ("equal", "estimate")}  # instead of files
OUTSIDE = "Copy the file into the folder, or pass it with the option on the command line"
Options = TypeVar("Options", bound=records.Record)


def read_settings(folder: Path, kind: type[records.Record]) -> dict[str, Any]:
    """Return the values of splinecli.toml in a folder. Its keys are fields of `kind` with hyphens.

    Paths are returned relative to the working directory. Raises InputError if the file is not TOML,
    a name or type is invalid, a path is outside the folder, or the folder cannot be read.
    """
    path = find_named(folder, [SETTINGS])
    if path is None:
        return {}
    kinds = {
        name.replace("_", "-"): each
        for name, each in records.field_types(kind).items()
        if (option := records.option_of(each)) is not None and option.panel != "Output"
    }
    try:
        text = path.read_text("utf-8-sig")
        given = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        hint = "Write lines such as transfer = 'srgb', or remove the file"
        raise InputError(f"is not valid TOML: {error}", path=path, hint=hint) from None
    found = {}
    names = [row.partition("=")[0].strip(" \t\"'") for row in text.splitlines()]
    for key, value in given.items():
        line = names.index(key) + 1 if key in names else None
        fail = partial(InputError, path=path, line=line, hint=CORRECT)
        if key not in kinds:
            hint = did_you_mean(key.replace("_", "-"), kinds) or CORRECT
            names_of = ", ".join(sorted(kinds))
            raise fail(f"unknown setting {key!r}, expected one of {names_of}", hint=hint)
        try:
            one = records.converted(kinds[key], value, f"setting {key!r}", InputError)
        except InputError as error:
            raise fail(error.problem) from None
        if records.is_file_name(kinds[key]) and one not in _WORDS.get(key, ()):
            if not resolve(folder / one).is_relative_to(resolve(folder)):
                problem = f"{key} is {one!r}, expected a path inside the folder"
                raise fail(problem, hint=OUTSIDE)
            one = str(folder / one)
        found[key.replace("-", "_")] = one
    try:
        kind(**found)
    except UsageError as error:
        raise InputError(error.problem, path=path, hint=error.hint or CORRECT) from None
    return found


def settings_text(options: records.Record, kind: type[records.Record], folder: Path) -> str:
    """Return the content of a settings file with the options that differ from the defaults of
    `kind`.

    Raises UsageError for a file outside the folder.
    """
    lines = []
    for field in fields(kind):
        value, key = getattr(options, field.name, field.default), field.name.replace("_", "-")
        if value == field.default:
            continue
        if records.is_file_name(records.field_types(kind)[field.name]) and value not in _WORDS.get(
            key, ()
        ):
            path = resolve(Path(value))
            if not path.is_relative_to(resolve(folder)):
                raise UsageError(f"--{key} {value} is outside {folder}", hint=OUTSIDE)
            value = path.relative_to(resolve(folder)).as_posix()
        lines.append(f"{key} = {json.dumps(value)}\n")  # for these types, JSON is valid TOML
    return "".join(lines)


def with_settings(options: Options, folder: Path, kind: type[records.Record]) -> Options:
    """Return the options with values from splinecli.toml instead of defaults.

    Raises InputError, or UsageError if options conflict.
    """
    settings = read_settings(folder, kind)
    if not settings:
        return options
    taken = {
        name: value
        for name, value in settings.items()
        if name in options.__struct_fields__ and not options.has(name)
    }
    of_folder = kind(**settings)
    for first, second, _ in options.CONFLICTS:  # options on the command line take precedence
        for one, other in ((first, second), (second, first)):
            name = other.partition("=")[0]
            if name in settings and options.has(one) and of_folder.has(other):
                taken.pop(name, None)
    try:
        return options.replace(**taken)
    except UsageError as error:
        hint = f"{error.hint}. " if error.hint else ""
        hint += f"{SETTINGS} sets {', '.join(key.replace('_', '-') for key in taken)}"
        raise UsageError(error.problem, folder / SETTINGS, hint=hint) from None
