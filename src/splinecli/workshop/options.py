"""The options of `prepare`, `train` and `import-weights`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from msgspec import NODEFAULT, Meta

from splinecli.errors import UsageError
from splinecli.pipeline import infer_options as shared
from splinecli.pipeline.infer_options import OUTPUT, Display, WorkerOptions
from splinecli.records.base import Count, Natural, NotNegative, Record, Seed, flag, option
from splinecli.workshop import training


class PrepareOptions(Display, frozen=True, kw_only=True):
    """The options of `prepare`."""

    sources: tuple[Path, ...] = option(
        "Arguments",
        "Captures with ground truth, folders of them, CyclesPS trees.",
        "SOURCE",
        value=(),
    )
    as_stored: shared.AsStored = False
    white_level: shared.GivenWhiteLevel = None
    update: shared.Update = False
    scenes: Natural = option("Scenes", "Render N random scenes.", "N", value=0)
    groups: Natural = option(
        "Scenes",
        "Render N random groups of bodies. The meshes are among the bodies, and rendered alone"
        " only with --views.",
        "N",
        value=0,
    )
    meshes: tuple[Path, ...] = option(
        "Scenes",
        "Render a scene of this mesh (PLY, OBJ, STL, OFF). May be repeated.",
        "FILE",
        value=(),
        names="--mesh",
    )
    views: Natural = option(
        "Scenes",
        "Render each mesh N times, from random views. 0 renders it once, along its +z axis.",
        "N",
        value=0,
    )
    reliefs: tuple[Path, ...] = option(
        "Scenes",
        "Put this tileable normal map on half of the scenes. May be repeated.",
        "FILE",
        value=(),
        names="--relief",
    )
    size: Annotated[int, Meta(ge=8)] | None = option(
        "Scenes", "Width and height of the rendered images.", "PIXELS", "128"
    )
    n_lights: Annotated[int, Meta(ge=16)] | None = option(
        "Scenes", "Number of lights of a rendered scene.", "N", "100"
    )
    seed: Seed = option("Scenes", "Seed of the random draws.", "S", value=0)
    output: Path = option(
        "Output", "Folder of the pixel set.", "SET", value=NODEFAULT, names=OUTPUT
    )
    processes: WorkerOptions = WorkerOptions()


def parse_light_counts(text: str) -> dict[str, int]:
    """Return the settings of the pixels for --n-lights, "K" or "MIN-MAX".

    The usual number of lights is 10, as published, or the nearest number in the range. Raises
    UsageError if the text is not a valid range, or if a pixel would have fewer than 3 lights.
    """
    low, dash, high = text.partition("-")
    try:
        fewest, most = int(low), int(high if dash else low)
    except ValueError:
        raise UsageError(
            f"--n-lights is {text!r}; expected a number such as 10, or a range such as 4-96"
        ) from None
    if not 3 <= fewest <= most:
        raise UsageError(
            f"--n-lights is {text!r}; expected at least 3 lights, the smaller number first"
        )
    return {"min_lights": fewest, "max_lights": most, "usual_lights": min(max(10, fewest), most)}


class TrainOptions(Record, frozen=True, kw_only=True):
    """The options of `train`."""

    sets: tuple[Path, ...] = option(
        "Arguments", "Pixel sets made by 'splinecli prepare'.", "SET", value=()
    )
    preset: str | None = option(
        "Settings",
        f"Settings to begin with: {', '.join(training.PRESET_NAMES)}.",
        "NAME",
        training.DEFAULT_PRESET,
        complete=training.PRESET_NAMES,
    )
    config: Path | None = option(
        "Settings", "Settings from a TOML file or a run's config.json.", "FILE"
    )
    param: tuple[str, ...] = option(
        "Settings",
        "One setting, such as pixels.wall_share=0.3. May be repeated.",
        "NAME=VALUE",
        value=(),
    )
    start_from: str | None = option(
        "Settings",
        "Begin with these weights: a file, or a shipped name.",
        "FILE",
        "random weights; preset refine: spline-net",
        complete=shared.complete_weights,
    )
    seed: Seed | None = option("Settings", "Seed of the run.", "S", "0")
    generator_weight: NotNegative | None = option(
        "Pixels", "Weight of generated pixels; each SET has weight 1.", "W", "0; 1 without SET"
    )
    n_lights: dict[str, int] | None = option(
        "Pixels",
        "Number of lights of each pixel, or a range such as 4-96.",
        "K",
        "the preset's",
        parse=parse_light_counts,
    )
    steps: Count | None = option(
        "Length",
        "Train for N steps.",
        "N",
        f"{training.DEFAULT_STEPS:,}; presets paper: {training.PAPER_STEPS:,}, refine:"
        f" {training.REFINE_STEPS:,}",
    )
    minutes: Annotated[float, Meta(ge=0.01)] | None = option(
        "Length", "Train for M minutes instead of a number of steps.", "M", "train for --steps"
    )
    resume: bool = flag("Length", "Continue from the run's checkpoint.")
    output: Path = option(
        "Output",
        f"Folder of the run. Its files are updated every {training.CHECKPOINT_SECONDS} seconds.",
        "RUN",
        value=NODEFAULT,
        names=OUTPUT,
    )
    tensorboard: bool = flag(
        "Output", "Also write RUN/tensorboard (needs the extra 'tensorboard')."
    )
    quiet: shared.Quiet = False
    device: shared.DeviceName = "auto"

    CONFLICTS = (("steps", "minutes", shared.LEAVE_ONE),)


class ImportOptions(Record, frozen=True, kw_only=True):
    """The options of `import-weights`."""

    li_net: Path = option(
        "Arguments",
        "The authors' LI-Net, which they call the generator.",
        "G.ckpt",
        value=NODEFAULT,
    )
    ne_net: Path = option(
        "Arguments",
        "The authors' NE-Net, which they call the discriminator.",
        "D.ckpt",
        value=NODEFAULT,
    )
    output: Path = option(
        "Output", "The weight file to write.", "FILE.safetensors", value=NODEFAULT, names=OUTPUT
    )
    overwrite: bool = flag("Output", "Replace an existing file.")
    quiet: shared.Quiet = False
