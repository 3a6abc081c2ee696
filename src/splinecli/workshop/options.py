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
            "Arguments", "Captures with ground truth, folders of them, CyclesPS trees.", "SOURCE"
        ),
    ] = ()
    as_stored: shared.AsStored = False
    white_level: shared.WhiteLevel = None
    update: shared.Update = False
    scenes: Annotated[Natural, Option("Scenes", "Render N random scenes.", "N")] = 0
    meshes: Annotated[
        tuple[Path, ...],
        Option(
            "Scenes",
            "Render a scene of this mesh (PLY, OBJ, STL, OFF). May be repeated.",
            "FILE",
            names="--mesh",
        ),
    ] = ()
    views: Annotated[
        Natural,
        Option(
            "Scenes",
            "Render each mesh N times, from random views. 0 renders it once, along its +z axis.",
            "N",
        ),
    ] = 0
    reliefs: Annotated[
        tuple[Path, ...],
        Option(
            "Scenes",
            "Put this tileable normal map on half of the scenes. May be repeated.",
            "FILE",
            names="--relief",
        ),
    ] = ()
    size: Annotated[
        Annotated[int, Meta(ge=8)] | None,
        Option("Scenes", "Width and height of the rendered images.", "PIXELS", "128"),
    ] = None
    n_lights: Annotated[
        Annotated[int, Meta(ge=16)] | None,
        Option("Scenes", "Number of lights of a rendered scene.", "N", "100"),
    ] = None
    seed: Annotated[Seed, Option("Scenes", "Seed of the random draws.", "S")] = 0
    output: Annotated[Path, Option("Output", "Folder of the pixel set.", "SET", names=OUTPUT)]
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
        tuple[Path, ...], Option("Arguments", "Pixel sets made by 'splinecli prepare'.", "SET")
    ] = ()
    preset: Annotated[
        str | None,
        Option(
            "Settings",
            f"Settings to begin with: {', '.join(training.PRESET_NAMES)}.",
            "NAME",
            training.DEFAULT_PRESET,
            complete=training.PRESET_NAMES,
        ),
    ] = None
    config: Annotated[
        Path | None, Option("Settings", "Settings from a TOML file or a run's config.json.", "FILE")
    ] = None
    param: Annotated[
        tuple[str, ...],
        Option(
            "Settings", "One setting, such as pixels.wall_share=0.3. May be repeated.", "NAME=VALUE"
        ),
    ] = ()
    start_from: Annotated[
        str | None,
        Option(
            "Settings",
            "Begin with these weights.",
            "NAME|FILE",
            "random weights; preset refine: spline-net",
            complete=shared.complete_weights,
        ),
    ] = None
    seed: Annotated[Seed | None, Option("Settings", "Seed of the run.", "S", "0")] = None
    generator_weight: Annotated[
        NotNegative | None,
        Option(
            "Pixels", "Weight of generated pixels; each SET has weight 1.", "W", "0; 1 without SET"
        ),
    ] = None
    n_lights: Annotated[
        dict[str, int] | None,
        Option(
            "Pixels",
            "Number of lights of each pixel.",
            "K|MIN-MAX",
            "the preset's",
            parse=parse_light_counts,
        ),
    ] = None
    steps: Annotated[
        Count | None,
        Option(
            "Length",
            "Train for N steps.",
            "N",
            f"{training.DEFAULT_STEPS:,}; presets paper: {training.PAPER_STEPS:,}, refine:"
            f" {training.REFINE_STEPS:,}",
        ),
    ] = None
    minutes: Annotated[
        Annotated[float, Meta(ge=0.01)] | None,
        Option(
            "Length", "Train for M minutes instead of a number of steps.", "M", "train for --steps"
        ),
    ] = None
    resume: Annotated[bool, Option("Length", "Continue from the run's checkpoint.")] = False
    output: Annotated[
        Path,
        Option(
            "Output",
            f"Folder of the run. Its files are updated every {training.CHECKPOINT_SECONDS}"
            " seconds.",
            "RUN",
            names=OUTPUT,
        ),
    ]
    tensorboard: Annotated[
        bool, Option("Output", "Also write RUN/tensorboard (needs the extra 'tensorboard').")
    ] = False
    quiet: shared.Quiet = False
    device: shared.DeviceName = "auto"

    CONFLICTS = (("steps", "minutes", shared.LEAVE_ONE),)


class ImportOptions(Record, frozen=True, kw_only=True):
    """The options of `import-weights`."""

    li_net: Annotated[
        Path, Option("Arguments", "The authors' LI-Net, which they call the generator.", "G.ckpt")
    ]
    ne_net: Annotated[
        Path,
        Option("Arguments", "The authors' NE-Net, which they call the discriminator.", "D.ckpt"),
    ]
    output: Annotated[
        Path, Option("Output", "The weight file to write.", "FILE.safetensors", names=OUTPUT)
    ]
    overwrite: Annotated[bool, Option("Output", "Replace an existing file.")] = False
    quiet: shared.Quiet = False
