"""The settings of a training run as one frozen record, from presets, files and single settings."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from splinecli.capture.formats.numbers import read_lines
from splinecli.errors import InputError, ModelError, UsageError, check_one_of
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.weights import shipped_names
from splinecli.records.base import BelowOne, Count, Natural, NotNegative, Share, settings
from splinecli.system.files import expanded, parse_json
from splinecli.workshop.synthesis.pixels import PixelGeneratorConfig
from splinecli.workshop.training import DEFAULT_PRESET, DEFAULT_STEPS, PAPER_STEPS, REFINE_STEPS

# the online pixel generator among the sources; every other name is the path of a pixel set
GENERATOR = "generator"
Norm = Literal["mean", "sum"]  # whether the values of a map's cells are averaged or summed


@dataclass(frozen=True)
class TrainingConfig:
    """The settings of a training run."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    pixels: PixelGeneratorConfig = field(default_factory=PixelGeneratorConfig)
    # the sources of pixels and their weights. A weight is the source's share of the batches.
    sources: dict[str, NotNegative] = field(default_factory=lambda: {GENERATOR: 1.0})
    # name or file of the weights that the run starts from; empty for random ones
    start_from: str = ""
    held_share: Share = 0.1  # share of the scenes of a pixel set that is for validation
    batch_size: Count = 256  # pixels a step; captures a step for the refinement net
    # captures photographed before the first step, for the refinement nets. With 64, a net memorised
    # them and was worse on others for half an hour.
    first_captures: Count = 160
    # number of parts of a batch. The pixels of a shard come from one random stream and have nearly
    # equal numbers of lights. The number of processes must divide it.
    shards: Count = 4
    # "joint" updates both networks at each step. "alternating", as in the paper, makes
    # `ne_net_updates` steps for NE-Net, then one for LI-Net, while the other network is fixed.
    # "error_head" fixes both and trains the error head alone. "refine_net" fixes all these and
    # trains the refinement nets on pixel sets of rendered scenes.
    updates: Literal["joint", "alternating", "error_head", "refine_net"] = "joint"
    ne_net_updates: Count = 5
    # the highest rate. It rises over `warmup_steps` and then falls.
    learning_rate: NotNegative = 1.5e-3
    # "cosine" falls to a hundredth of the highest rate. "stepped", as the authors do, falls to a
    # tenth for the last tenth of the run.
    schedule: Literal["cosine", "stepped"] = "cosine"
    warmup_steps: Natural = 300
    # steps, minutes: the length of the run. If minutes is above 0, it replaces steps.
    steps: Count = DEFAULT_STEPS
    minutes: NotNegative = 0.0
    # beta1, beta2, weight_decay: settings of AdamW. With weight_decay = 0, AdamW is Adam.
    beta1: BelowOne = 0.9
    beta2: BelowOne = 0.99
    weight_decay: NotNegative = 1e-3
    gradient_limit: NotNegative = 1.0  # largest norm of the gradient; 0 for none
    # decay of the running average of the weights, which is saved; 0 for none
    average_decay: BelowOne = 0.9995
    # canonical networks train on pixels rotated by up to this angle, either way; half of the
    # batches are mirrored. Estimates from several views can then be averaged.
    turn_jitter_deg: NotNegative = 15.0
    # angle_weight, map_weight, masked_weight: weights of arccos(n . n_gt), |D - D_gt| and |M_s o (D
    # - D_gt)|.
    angle_weight: NotNegative = 1.0
    map_weight: NotNegative = 1.0
    masked_weight: NotNegative = 1.0
    # weight of the error of the differences between neighbours beside the angle, for the refinement
    # nets
    detail_weight: NotNegative = 1.0
    # symmetric_weight, asymmetric_weight: lambda_s and lambda_a, the weights of Ls and La
    symmetric_weight: NotNegative = 0.0
    asymmetric_weight: NotNegative = 0.0
    # eta, lambda_c: settings of La
    eta: NotNegative = 1.0
    lambda_c: NotNegative = 50.0
    # li_net_norm, ne_net_norm: whether the cells of a map are averaged or summed, in all terms of
    # LI-Net and in NE-Net's Ls and La. eta is in summed cells in either case.
    li_net_norm: Norm = "mean"
    ne_net_norm: Norm = "sum"
    # "bfloat16" runs the convolutions in bfloat16 where the device computes in it, "float32" never
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    seed: Natural = 0

    def __post_init__(self) -> None:
        """Raise ModelError for settings that do not fit together."""
        if self.batch_size % self.shards:
            raise ModelError(
                f"training setting 'batch_size' is {self.batch_size}; expected a multiple of"
                f" shards = {self.shards}"
            )
        lights = self.pixels
        if (pixels := self.batch_size // self.shards) % lights.captures(
            pixels
        ) and self.updates != "refine_net":
            raise ModelError(
                f"training setting 'batch_size' is {self.batch_size}; expected a multiple of"
                f" shards * capture_pixels = {self.shards * lights.capture_pixels}, or fewer"
            )
        if not lights.min_lights <= lights.usual_lights <= lights.max_lights:
            raise ModelError(
                f"training settings min_lights, usual_lights, max_lights are {lights.min_lights},"
                f" {lights.usual_lights}, {lights.max_lights}; expected them in ascending order"
            )
        if self.network.grid != "even":
            raise ModelError(
                f"network setting 'grid' is {self.network.grid!r}; training has true maps on the"
                " grid 'even' only"
            )
        if self.updates == "alternating" and not self.network.interpolates:
            raise ModelError("training setting 'updates' is 'alternating', which needs a LI-Net")
        if (self.updates in ("error_head", "refine_net")) != self.network.error_head:
            raise ModelError(
                f"training settings 'updates' and 'network.error_head' are {self.updates!r} and"
                f" {self.network.error_head}; the updates 'error_head' and 'refine_net' need an"
                " error head, no others"
            )
        if (self.updates == "refine_net") != self.network.refines:
            raise ModelError(
                f"training settings 'updates' and 'network.refines' are {self.updates!r} and"
                f" {self.network.refines}; the updates 'refine_net' need a refinement net, and"
                " only they train one"
            )
        if not sum(self.sources.values()) > 0:
            raise ModelError("training setting 'sources' has no weight above 0")

    def to_dict(self) -> dict[str, Any]:
        """Return nested plain values, as stored in checkpoints and config.json."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainingConfig:
        """Rebuild a configuration from plain values. Raises ModelError for an unknown key or an
        impossible value.
        """
        values = dict(values)
        for name, read in (("network", NetworkConfig.from_dict), ("pixels", _pixels)):
            if name in values:
                if not isinstance(values[name], dict):
                    raise ModelError(
                        f"training setting {name!r} is {values[name]!r}; expected a table of"
                        " settings"
                    )
                values[name] = read(values[name])
        return cls(**settings(cls, values, "training setting", ModelError))


def _pixels(values: dict[str, Any]) -> PixelGeneratorConfig:
    # Every configuration of an earlier version has them, most often unused: 0 and "".
    values = dict(values)
    for name in ("measured_share", "measured_materials"):
        if value := values.pop(name, None):
            raise ModelError(
                f"training setting {name!r} is {value!r}, but training with measured materials was"
                " removed",
                hint="Leave measured_share and measured_materials out",
            )
    return PixelGeneratorConfig(
        **settings(PixelGeneratorConfig, values, "training setting", ModelError)
    )


# The paper's text (section 4) where it speaks, the authors' code where it does not: docs/train.md.
# Half of the paper's cells a side: the set branch has the exact directions that larger cells round.
_COMPACT = NetworkConfig(
    map_size=16, fits=("ls", "iw12", "iw12-all", "ia14"), set_width=64, sees_capture=True
)
# As many captures with many lights as with few, and as many with 8 bits as strangers have
_CAMERAS: dict[str, Any] = {"usual_lights_share": 0.0, "eight_bit_share": 0.4}

PRESETS = {
    "compact": TrainingConfig(
        network=_COMPACT,
        pixels=PixelGeneratorConfig(capture_pixels=64, **_CAMERAS),
        batch_size=512,
        shards=2,
    ),
    "refine": TrainingConfig(
        network=replace(_COMPACT, error_head=True, refines=True, refines_twice=True),
        pixels=PixelGeneratorConfig(**_CAMERAS),
        start_from="spline-net",
        updates="refine_net",
        batch_size=4,
        shards=1,
        learning_rate=1e-3,
        warmup_steps=100,
        steps=REFINE_STEPS,
        average_decay=0.998,
    ),
    "paper": TrainingConfig(
        network=NetworkConfig(size="paper"),
        pixels=PixelGeneratorConfig(min_lights=10, max_lights=10, usual_lights=10),
        batch_size=128,
        updates="alternating",
        learning_rate=1e-4,
        schedule="stepped",
        warmup_steps=0,
        steps=PAPER_STEPS,
        beta1=0.9,
        beta2=0.999,
        weight_decay=0.0,
        turn_jitter_deg=0.0,
        gradient_limit=0.0,
        average_decay=0.0,
        symmetric_weight=2e-2,
        asymmetric_weight=2e-5,
        li_net_norm="sum",
    ),
    # CNN-PS (Ikehata, ECCV 2018) for ten lights: its layers on the sparse map alone.
    "cnn-ps": TrainingConfig(
        network=NetworkConfig(size="paper", interpolates=False),
        pixels=PixelGeneratorConfig(min_lights=10, max_lights=10, usual_lights=10),
        learning_rate=1e-3,
    ),
}


def preset(name: str, **changes: Any) -> TrainingConfig:
    """Return a preset with some settings changed. Raises UsageError for an unknown name."""
    check_one_of("preset", name, PRESETS)
    return replace(PRESETS[name], **changes)


# settings that may change when a run continues
CHANGEABLE = (
    "steps",
    "minutes",
    "learning_rate",
    "gradient_limit",
)
_MOST_POINTS = 300  # in a line of a TOML file
# nested settings, as in TrainingConfig.to_dict; only some of them may be given
Settings = dict[str, Any]


def read_config_file(path: Path) -> Settings:
    """Read the settings of a TOML file or of a run's config.json. Raises ModelError."""
    try:
        lines = read_lines(path)
        for number, line in enumerate(lines, start=1):
            # tomllib takes time and memory in the square of a name's length, 6 GB for 80 kB.
            if path.suffix != ".json" and (count := line.count(".")) > _MOST_POINTS:
                problem = f"found {count} points in a line, expected at most {_MOST_POINTS}"
                raise ModelError(problem, path, line=number, hint="Give each setting its own line")
        text = "\n".join(lines)
        values: Any = parse_json(text) if path.suffix == ".json" else tomllib.loads(text)
    except InputError as error:
        raise ModelError(error.problem, path=path, hint=error.hint) from error
    except RecursionError:
        raise ModelError("is nested too deeply", path=path) from None
    except ValueError as error:  # raised by both decoders
        raise ModelError(
            f"is not {'JSON' if path.suffix == '.json' else 'TOML'} ({error})", path=path
        ) from error
    if not isinstance(values, dict):
        raise ModelError("is not a table of settings", path=path)
    return values


def parse_parameter(text: str) -> Settings:
    """Return a setting as nested values: "a.b=value" becomes {"a": {"b": value}}.

    The value is read as TOML, or as text if it is not valid TOML. Raises UsageError if there is no
    name or no "=".
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
    nested: Settings = parsed
    return nested


def parse_sources(sets: Sequence[Path], generator_weight: float | None) -> dict[str, float]:
    """Return the weights of the sources: 1 for each set, and the weight of the generator.

    By default, the generator has weight 0 if there are sets, and 1 otherwise.
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
    """Return a preset, changed by the settings of a file and then by `changes`, in this order.

    A table of sources is replaced as a whole. Other tables are merged key by key. If no preset is
    named, the entry "preset" in the file is used, or `base`, which is DEFAULT_PRESET for None.
    Raises UsageError if there is no such preset, or ModelError if a setting is unknown or its value
    is not allowed. The message names the file that contains it.
    """
    given = read_config_file(file) if file else {}
    named = given.pop("preset", DEFAULT_PRESET if base is None else None)
    named = preset_name or named
    values = (base if base is not None and named is None else preset(str(named))).to_dict()
    try:
        values = _merge(values, given)
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

    sources = {
        name if name == GENERATOR else absolute(name): weight
        for name, weight in config.sources.items()
    }
    start_from = config.start_from
    if start_from not in shipped_names() and Path(start_from).suffix == ".safetensors":
        start_from = absolute(start_from)
    return replace(config, sources=sources, start_from=start_from)


def check_resumable(started: TrainingConfig, asked: TrainingConfig, path: Path) -> None:
    """Raise ModelError, with the path of the checkpoint, if a setting differs and is not in
    CHANGEABLE.
    """
    old, new = _flat(started.to_dict()), _flat(asked.to_dict())
    # In the order of the configuration, where the most important settings, such as the network's
    # size, come first.
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
        flat |= (
            _flat(value, f"{prefix}{key}.")
            if isinstance(value, dict)
            else {f"{prefix}{key}": value}
        )
    return flat
