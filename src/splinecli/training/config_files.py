"""Configurations from files and the command line: a preset, changed by a file, changed by single settings."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splinecli.errors import ModelError, UsageError
from splinecli.networks.weights import shipped_names
from splinecli.training.config import GENERATOR, TrainingConfig, preset

DEFAULT_PRESET = "compact"


def read_config_file(path: Path) -> dict[str, Any]:
    """The settings of a TOML file, or of a run's config.json. Raises ModelError."""
    try:
        text = path.read_text("utf-8")
        values: Any = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise ModelError(f"cannot be read ({error.strerror})", path=path) from error
    except ValueError as error:  # both decoders' errors, and text that is not UTF-8
        raise ModelError(
            f"is not {'JSON' if path.suffix == '.json' else 'TOML'} ({error})", path=path
        ) from error
    if not isinstance(values, dict):
        raise ModelError("holds no table of settings", path=path)
    return values


def parse_parameter(text: str) -> dict[str, Any]:
    """{"a": {"b": value}} from "a.b=value"; the value as in TOML, or else a plain text. Raises UsageError."""
    name, equals, value = text.partition("=")
    keys = [key.strip() for key in name.split(".")]
    if not equals or not all(keys):
        raise UsageError(f"--param is {text!r}; expected NAME=VALUE such as pixels.wall_share=0.3")
    try:
        parsed: Any = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    for key in reversed(keys):
        parsed = {key: parsed}
    settings: dict[str, Any] = parsed
    return settings


def configure(
    preset_name: str | None = None, file: Path | None = None, changes: Sequence[dict[str, Any]] = ()
) -> TrainingConfig:
    """The preset (`preset_name`, or else the file's entry "preset", or else compact), changed.

    First come the settings of the file, then `changes` in their order. A table of sources is replaced as a
    whole, other tables key by key.

    Raises:
        UsageError: no such preset.
        ModelError: a setting is unknown or cannot be; the message names the file it stands in.
    """
    settings = read_config_file(file) if file else {}
    named = settings.pop("preset", DEFAULT_PRESET)
    values = preset(preset_name or str(named)).to_dict()
    try:
        values = _merge(values, settings)
        TrainingConfig.from_dict(values)
    except ModelError as error:
        raise ModelError(error.problem, path=file, hint=error.hint) from error
    for change in changes:
        values = _merge(values, change)
    return _with_absolute_paths(TrainingConfig.from_dict(values))


def _with_absolute_paths(config: TrainingConfig) -> TrainingConfig:
    # So that a run can be taken up from another folder.
    sources = {
        name if name == GENERATOR else str(Path(name).absolute()): weight
        for name, weight in config.sources.items()
    }
    pixels = config.pixels
    if pixels.measured_materials:
        pixels = replace(pixels, measured_materials=str(Path(pixels.measured_materials).absolute()))
    start_from = config.start_from
    if start_from not in shipped_names() and Path(start_from).suffix == ".safetensors":
        start_from = str(Path(start_from).absolute())
    return replace(config, sources=sources, pixels=pixels, start_from=start_from)


def _merge(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(values)
    for key, value in changes.items():
        known = merged.get(key)
        keywise = isinstance(known, dict) and isinstance(value, dict) and key != "sources"
        merged[key] = _merge(known, value) if keywise else value  # type: ignore[arg-type]
    return merged


CHANGEABLE = ("steps", "minutes", "learning_rate", "gradient_limit")
"""What a run may change when it is gone on with."""


def configure_resumed(
    begun: TrainingConfig,
    path: Path,
    preset_name: str | None = None,
    file: Path | None = None,
    changes: Sequence[dict[str, Any]] = (),
) -> TrainingConfig:
    """The configuration of a run that was begun, with what is asked for now.

    Without a preset, what is not asked for stays as it was begun.

    Raises:
        UsageError, ModelError: as for `configure`; or a setting differs that only another run can have; the
            message names it and the run's checkpoint, `path`.
    """
    settings = read_config_file(file) if file else {}
    if preset_name is None and "preset" not in settings:
        values = begun.to_dict()
        for change in (settings, *changes):
            values = _merge(values, change)
        asked = _with_absolute_paths(TrainingConfig.from_dict(values))
    else:
        asked = configure(preset_name, file, changes)
    old, new = _flat(begun.to_dict()), _flat(asked.to_dict())
    # In the order of the configuration: what says most, such as the network's size, comes first.
    for name in [*new, *(name for name in old if name not in new)]:
        if name not in CHANGEABLE and old.get(name) != new.get(name):
            raise ModelError(
                f"the run was begun with {name} = {old.get(name)!r}, this asks for {new.get(name)!r}",
                path=path,
                hint="Leave the setting out to go on as it was begun, or choose another -o",
            )
    return asked


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
