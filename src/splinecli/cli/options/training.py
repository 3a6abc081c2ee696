"""Options of prepare, train and import-weights: pixel sets, rendered scenes and the settings of a training run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from splinecli.cli.options.values import complete_weights
from splinecli.training.defaults import DEFAULT_PRESET, PRESET_NAMES

# Pixel sets of prepare.

Sources = Annotated[
    list[Path] | None,
    Argument(metavar="SOURCE", help="Captures with ground truth, folders of them, CyclesPS trees."),
]
Scenes = Annotated[int, Option(metavar="N", min=0, help="Render N random scenes.")]
Meshes = Annotated[
    list[Path] | None,
    Option(metavar="FILE", help="Render a scene of this mesh (PLY, OBJ, STL, ...). Repeatable."),
]
ImageSize = Annotated[
    int | None,
    Option(metavar="PIXELS", min=8, help="Width and height of the rendered images. [default: 128]"),
]
SceneLights = Annotated[
    int | None, Option(metavar="F", min=16, help="Number of lights of a rendered scene. [default: 500]")
]
Measured = Annotated[Path | None, Option(metavar="FILE", help="Also use these measured materials (.npz).")]
MeasuredShare = Annotated[
    float, Option(metavar="SHARE", min=0, max=1, help="Share of the materials that are measured.")
]

# Settings of train.

Sets = Annotated[list[Path] | None, Argument(metavar="SET", help="Pixel sets made by 'splinecli prepare'.")]
Preset = Annotated[
    str | None,
    Option(
        metavar="NAME",
        help=f"Settings to begin with: {', '.join(PRESET_NAMES)}. [default: {DEFAULT_PRESET}]",
        autocompletion=lambda: list(PRESET_NAMES),
    ),
]
Config = Annotated[
    Path | None, Option(metavar="FILE", help="Settings from a TOML file or a run's config.json.")
]
Parameters = Annotated[
    list[str] | None,
    Option(metavar="NAME=VALUE", help="One setting, such as pixels.wall_share=0.3. Repeatable."),
]
StartFrom = Annotated[
    str | None,
    Option(
        metavar="NAME|FILE",
        help="Begin with these weights instead of random ones.",
        autocompletion=complete_weights,
    ),
]
GeneratorWeight = Annotated[
    float | None,
    Option(
        metavar="W",
        min=0,
        help="Weight of generated pixels, where each SET has weight 1. [default: 0; 1 without SET]",
    ),
]
LightCounts = Annotated[
    str | None,
    Option(metavar="K|MIN-MAX", help="Number of lights of each pixel. [default: the preset's]"),
]
Steps = Annotated[int | None, Option(metavar="N", min=1, help="Train for N steps.")]
Minutes = Annotated[float | None, Option(metavar="M", min=0.01, help="Train for M minutes.")]
Resume = Annotated[bool, Option("--resume", help="Continue from the run's checkpoint.")]
RunSeed = Annotated[
    int | None, Option(metavar="S", min=0, max=2**32 - 1, help="Seed of the run. [default: 0]")
]

# The authors' checkpoints, for import-weights.

OfficialLiNet = Annotated[
    Path, Argument(metavar="G.ckpt", help="The authors' LI-Net, which they call the generator.")
]
OfficialNeNet = Annotated[
    Path, Argument(metavar="D.ckpt", help="The authors' NE-Net, which they call the discriminator.")
]
