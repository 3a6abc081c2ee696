"""The options of `prepare`, `train` and `import-weights`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from msgspec import Meta

from splinecli.errors import UsageError
from splinecli.pipeline import infer_options as shared
from splinecli.pipeline.infer_options import OUTPUT, Display, Workers
from splinecli.records.base import Count, Natural, NotNegative, Option, Record, Seed
from splinecli.workshop import training


class PrepareOptions(Display, frozen=True, kw_only=True):
    """The options of `prepare`."""

    sources: Annotated[
        tuple[Path, ...],
        Option(
            "Arguments",
            "SOURCE",
            "Captures with ground truth, folders of them, CyclesPS trees.",
            repeated=True,
        ),
    ] = ()
    as_stored: shared.AsStored = False
    white_level: shared.WhiteLevel = None
    update: shared.Update = False
    scenes: Annotated[Natural, Option("Scenes", "N", "Render N random scenes.")] = 0
    meshes: Annotated[
        tuple[Path, ...],
        Option(
            "Scenes",
            "FILE",
            "Render a scene of this mesh (PLY, OBJ, STL, OFF). May be repeated.",
            names=("--mesh",),
            repeated=True,
        ),
    ] = ()
    views: Annotated[
        Natural,
        Option(
            "Scenes",
            "N",
            "Render each mesh N times, from random views. 0 renders it once, along its +z axis.",
        ),
    ] = 0
    reliefs: Annotated[
        tuple[Path, ...],
        Option(
            "Scenes",
            "FILE",
            "Put this tileable normal map on half of the scenes. May be repeated.",
            names=("--relief",),
            repeated=True,
        ),
    ] = ()
    size: Annotated[
        Annotated[int, Meta(ge=8)] | None,
        Option("Scenes", "PIXELS", "Width and height of the rendered images.", default="128"),
    ] = None
    n_lights: Annotated[
        Annotated[int, Meta(ge=16)] | None,
        Option("Scenes", "N", "Number of lights of a rendered scene.", default="100"),
    ] = None
    seed: Annotated[Seed, Option("Scenes", "S", "Seed of the random draws.")] = 0
    output: Annotated[Path, Option("Output", "SET", "Folder of the pixel set.", names=OUTPUT)]
    processes: Workers = Workers()


def parse_light_counts(text: str) -> dict[str, int]:
    """Parse --n-lights, "K" or "MIN-MAX", into settings of the pixels.

    The usual number of lights is 10, as published, or the nearest number in the range. Raises
    UsageError if the text is not a valid range, or a pixel would have fewer than 3 lights.
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

    sets: Annotated[
        tuple[Path, ...],
        Option("Arguments", "SET", "Pixel sets made by 'splinecli prepare'.", repeated=True),
    ] = ()
    preset: Annotated[
        str | None,
        Option(
            "Settings",
            "NAME",
            f"Settings to begin with: {', '.join(training.PRESET_NAMES)}.",
            default=training.DEFAULT_PRESET,
            complete=training.PRESET_NAMES,
        ),
    ] = None
    config: Annotated[
        Path | None, Option("Settings", "FILE", "Settings from a TOML file or a run's config.json.")
    ] = None
    param: Annotated[
        tuple[str, ...],
        Option(
            "Settings",
            "NAME=VALUE",
            "One setting, such as pixels.wall_share=0.3. May be repeated.",
            repeated=True,
        ),
    ] = ()
    start_from: Annotated[
        str | None,
        Option(
            "Settings",
            "NAME|FILE",
            "Begin with these weights.",
            default="random weights; preset refine: spline-net",
            complete=shared.complete_weights,
        ),
    ] = None
    seed: Annotated[Seed | None, Option("Settings", "S", "Seed of the run.", default="0")] = None
    generator_weight: Annotated[
        NotNegative | None,
        Option(
            "Pixels",
            "W",
            "Weight of generated pixels; each SET has weight 1.",
            default="0; 1 without SET",
        ),
    ] = None
    n_lights: Annotated[
        dict[str, int] | None,
        Option(
            "Pixels",
            "K|MIN-MAX",
            "Number of lights of each pixel.",
            default="the preset's",
            parse=parse_light_counts,
        ),
    ] = None
    steps: Annotated[
        Count | None,
        Option(
            "Length",
            "N",
            "Train for N steps.",
            default=f"{training.DEFAULT_STEPS:,}; presets paper: {training.PAPER_STEPS:,}, refine:"
            f" {training.REFINE_STEPS:,}",
        ),
    ] = None
    minutes: Annotated[
        Annotated[float, Meta(ge=0.01)] | None,
        Option(
            "Length",
            "M",
            "Train for M minutes instead of a number of steps.",
            default="train for --steps",
        ),
    ] = None
    resume: Annotated[bool, Option("Length", "", "Continue from the run's checkpoint.")] = False
    output: Annotated[
        Path,
        Option(
            "Output",
            "RUN",
            f"Folder of the run. Its files are updated every {training.CHECKPOINT_SECONDS}"
            " seconds.",
            names=OUTPUT,
        ),
    ]
    tensorboard: Annotated[
        bool, Option("Output", "", "Also write RUN/tensorboard (needs the extra 'tensorboard').")
    ] = False
    quiet: shared.Quiet = False
    device: shared.DeviceName = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps is not None and self.minutes is not None:
            raise UsageError("--steps and --minutes contradict each other", hint="Leave one out")


class ImportOptions(Record, frozen=True, kw_only=True):
    """The options of `import-weights`."""

    li_net: Annotated[
        Path, Option("Arguments", "G.ckpt", "The authors' LI-Net, which they call the generator.")
    ]
    ne_net: Annotated[
        Path,
        Option("Arguments", "D.ckpt", "The authors' NE-Net, which they call the discriminator."),
    ]
    output: Annotated[
        Path, Option("Output", "FILE.safetensors", "The weight file to write.", names=OUTPUT)
    ]
    overwrite: Annotated[bool, Option("Output", "", "Replace an existing file.")] = False
    quiet: shared.Quiet = False
