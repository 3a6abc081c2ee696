"""Training configurations from a preset, a file and single settings."""

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splinecli.capture.formats.numbers import read_lines
from splinecli.errors import InputError, ModelError, UsageError
from splinecli.networks.weights import shipped_names
from splinecli.system.files import expanded, parse_json
from splinecli.training.config import GENERATOR, TrainingConfig, preset
from splinecli.training.defaults import DEFAULT_PRESET

CHANGEABLE = ("steps", "minutes", "learning_rate", "gradient_limit")
"""The settings that may change when a run continues."""

Settings = dict[str, Any]  # nested settings, as in TrainingConfig.to_dict; only some of them may be given


def read_config_file(path: Path) -> Settings:
    """Read the settings of a TOML file or of a run's config.json. Raises ModelError."""
    try:
        text = "\n".join(read_lines(path))
        values: Any = parse_json(text) if path.suffix == ".json" else tomllib.loads(text)
    except InputError as error:
        raise ModelError(error.problem, path=path, hint=error.hint) from error
    except RecursionError:
        raise ModelError("is nested too deeply", path=path) from None
    except ValueError as error:  # raised by both decoders
        raise ModelError(f"is not {'JSON' if path.suffix == '.json' else 'TOML'} ({error})", path=path) from error
    if not isinstance(values, dict):
        raise ModelError("is not a table of settings", path=path)
    return values


def parse_parameter(text: str) -> Settings:
    """Parse one setting: "a.b=value" gives {"a": {"b": value}}.

    The value is read as TOML. A value that is not TOML is taken as text. Raises UsageError if there is no name or no
    "=".
    """
    name, equals, value = text.partition("=")
    keys = [key.strip() for key in name.split(".")]
    if not equals or not all(keys):
        raise UsageError(f"--param is {text!r}; expected NAME=VALUE such as pixels.wall_share=0.3")
    try:
        parsed: Any = tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):
        parsed = value.strip()
    for key in reversed(keys):
        parsed = {key: parsed}
    settings: Settings = parsed
    return settings


def parse_sources(sets: Sequence[Path], generator_weight: float | None) -> dict[str, float]:
    """Return the weights of the sources: 1 for each set, and the generator's.

    Without `generator_weight`, the generator has weight 0 if there are sets, else 1.
    """
    weights = {str(path): 1.0 for path in sets}
    if generator_weight is None:
        generator_weight = 0.0 if sets else 1.0
    return {**weights, GENERATOR: generator_weight} if generator_weight else weights


def configure(
    preset_name: str | None = None,
    file: Path | None = None,
    changes: Sequence[Settings] = (),
    *,
    base: TrainingConfig | None = None,
) -> TrainingConfig:
    """Return a preset, changed by the settings of a file and then by `changes`, in their order.

    A table of sources is replaced as a whole. Other tables are merged key by key. Without a name of a preset, the
    file's entry "preset" counts, or else `base`, which is DEFAULT_PRESET for None. Raises UsageError if there is no
    such preset, or ModelError if a setting is unknown or its value is not allowed. The message names the file it is in.
    """
    settings = read_config_file(file) if file else {}
    named = settings.pop("preset", DEFAULT_PRESET if base is None else None)
    named = preset_name or named
    values = (base if base is not None and named is None else preset(str(named))).to_dict()
    try:
        values = _merge(values, settings)
        TrainingConfig.from_dict(values)
    except ModelError as error:
        raise ModelError(error.problem, path=file, hint=error.hint) from error
    except RecursionError:
        raise ModelError("is nested too deeply", path=file) from None
    for change in changes:
        values = _merge(values, change)
    config = TrainingConfig.from_dict(values)

    def absolute(path: str) -> str:  # so that a run can continue from another working folder
        return str(expanded(path).absolute())

    sources = {name if name == GENERATOR else absolute(name): weight for name, weight in config.sources.items()}
    start_from = config.start_from
    if start_from not in shipped_names() and Path(start_from).suffix == ".safetensors":
        start_from = absolute(start_from)
    return replace(config, sources=sources, start_from=start_from)


def check_resumable(started: TrainingConfig, asked: TrainingConfig, path: Path) -> None:
    """Raise ModelError, with the path of the checkpoint, for a setting that differs and is not in CHANGEABLE."""
    old, new = _flat(started.to_dict()), _flat(asked.to_dict())
    # In the order of the configuration, where the most important settings, such as the network's size, come first.
    for name in [*new, *(name for name in old if name not in new)]:
        if name not in CHANGEABLE and old.get(name) != new.get(name):
            raise ModelError(
                f"the run was started with {name} = {old.get(name)!r}, not {new.get(name)!r}",
                path=path,
                hint="Leave the setting out to continue, or choose another -o",
            )


def _merge(values: Settings, changes: Settings) -> Settings:
    merged = dict(values)
    for key, value in changes.items():
        known = merged.get(key)
        keywise = isinstance(known, dict) and isinstance(value, dict) and key != "sources"
        merged[key] = _merge(known, value) if keywise else value  # type: ignore[arg-type]
    return merged


def _flat(values: Settings, prefix: str = "") -> Settings:
    flat: Settings = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
