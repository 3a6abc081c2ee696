"""Options of prepare, train and import-weights: pixel sets, rendered scenes and the settings of a training run."""

from __future__ import annotations

from typer import Argument, Option

from splinecli.cli.options.values import complete_weights
from splinecli.training.defaults import DEFAULT_PRESET, DEFAULT_STEPS, PAPER_STEPS, PRESET_NAMES, REFINE_STEPS

# Pixel sets of prepare.

SOURCES = Argument(None, metavar="SOURCE", help="Captures with ground truth, folders of them, CyclesPS trees.")
SCENES = Option(0, metavar="N", min=0, help="Render N random scenes.")
MESHES = Option(None, metavar="FILE", help="Render a scene of this mesh (PLY, OBJ, STL, OFF). May be repeated.")
IMAGE_SIZE = Option(None, metavar="PIXELS", min=8, help="Width and height of the rendered images. [default: 128]")
SCENE_LIGHTS = Option(
    None, "--n-lights", metavar="N", min=16, help="Number of lights of a rendered scene. [default: 500]"
)

# Settings of train.

SETS = Argument(None, metavar="SET", help="Pixel sets made by 'splinecli prepare'.")
PRESET = Option(
    None,
    metavar="NAME",
    help=f"Settings to begin with: {', '.join(PRESET_NAMES)}. [default: {DEFAULT_PRESET}]",
    autocompletion=lambda: list(PRESET_NAMES),
)
CONFIG = Option(None, metavar="FILE", help="Settings from a TOML file or a run's config.json.")
PARAMETERS = Option(None, metavar="NAME=VALUE", help="One setting, such as pixels.wall_share=0.3. May be repeated.")
START_FROM = Option(
    None,
    metavar="NAME|FILE",
    help="Begin with these weights. [default: random weights; preset refine: spline-net]",
    autocompletion=complete_weights,
)
GENERATOR_WEIGHT = Option(
    None,
    metavar="W",
    min=0,
    help="Weight of generated pixels; each SET has weight 1. [default: 0; 1 without SET]",
)
LIGHT_COUNTS = Option(None, metavar="K|MIN-MAX", help="Number of lights of each pixel. [default: the preset's]")
STEPS = Option(
    None,
    metavar="N",
    min=1,
    help=f"Train for N steps. [default: {DEFAULT_STEPS:,}; presets paper: {PAPER_STEPS:,}, refine: {REFINE_STEPS:,}]",
)
MINUTES = Option(
    None,
    metavar="M",
    min=0.01,
    help="Train for M minutes instead of a number of steps. [default: train for --steps]",
)
RESUME = Option(False, "--resume", help="Continue from the run's checkpoint.")
RUN_SEED = Option(None, metavar="S", min=0, max=2**32 - 1, help="Seed of the run. [default: 0]")

# The authors' checkpoints, for import-weights.

OFFICIAL_LI_NET = Argument(..., metavar="G.ckpt", help="The authors' LI-Net, which they call the generator.")
OFFICIAL_NE_NET = Argument(..., metavar="D.ckpt", help="The authors' NE-Net, which they call the discriminator.")
