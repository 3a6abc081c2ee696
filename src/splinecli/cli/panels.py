"""Which options stand together in the help of each command."""

from __future__ import annotations

SPEED = ("--device", "--precision")
VALUES = ("--transfer", "--ambient", "--flat-field", "--white-level")
PART = ("--crop", "--scale")
REFINED = ("--refine-lights", "--light-error-deg")
LAMPS = ("--light-positions", "--light-distance", "--pixel-size", "--object-width", "--camera-matrix")
REPEAT = ("--overwrite", "--json", "--quiet")

PANELS: dict[str, dict[str, tuple[str, ...]]] = {
    "infer": {
        "Input": ("--mask", "--auto-mask", *PART, "--ground-truth", *VALUES, "--as-stored"),
        "Lights": (
            "--lights",
            "--first-light",
            "--light-frame",
            "--lights-format",
            "--intensities",
            "--refine-lights",
            *LAMPS,
            "--n-lights",
            "--seed",
            "--light-indices",
        ),
        "Method": ("--method", "--weights"),
        "Output": (
            "--output",
            "--format",
            "--maps",
            "--html",
            "--surface",
            "--stiffness",
            "--convention",
            "--strict",
            "--update",
            "--overwrite",
            "--json",
            "--jsonl",
            "--quiet",
        ),
        "Speed": ("--distil", *SPEED),
        "Processes and machines": ("--workers", "--cluster", "--shard"),
    },
    "watch": {"Captures": ("--marker", "--settle")},
    "info": {
        "Input": ("--mask", *PART, "--ground-truth", *VALUES),
        "Lights": (
            "--lights",
            "--first-light",
            "--light-frame",
            "--lights-format",
            "--intensities",
            *LAMPS,
            "--check-lights",
            "--mended-lights",
        ),
        "Output": ("--plot", "--strict", *REPEAT),
    },
    "calibrate": {
        "Input": ("--circle", "--mask", "--ball-diameter", "--camera-matrix"),
        "Light intensities": ("--gray-ball", "--gray-card", "--transfer"),
        "Output": ("--output", "--compare", *REPEAT),
    },
    "integrate": {
        "Input": (
            "--mask",
            "--camera-matrix",
            "--pixel-size",
            "--convention",
            "--colours",
            "--prior",
        ),
        "Method": ("--stiffness", "--prior-detail", "--largest-step"),
        "Output": ("--output", "--format", "--decimate", *REPEAT),
    },
    "evaluate": {
        "Input": ("--skip-first", "--max-pixels", "--as-stored", "--white-level"),
        "Lights": ("--lights", "--n-lights", "--trials", "--seed", "--draws", "--light-noise-deg", *REFINED),
        "Method": ("--method", "--weights", "--rotations"),
        "Output": ("--output", "--figures", "--pixel", *REPEAT),
        "Speed": ("--jobs", *SPEED),
        "Processes and machines": ("--workers", "--cluster"),
    },
    "prepare": {
        "Input": ("--as-stored", "--update", "--white-level"),
        "Scenes": ("--scenes", "--mesh", "--size", "--n-lights", "--seed"),
        "Output": ("--output", *REPEAT),
        "Speed": ("--workers",),
    },
    "train": {
        "Settings": ("--preset", "--config", "--param", "--start-from", "--seed"),
        "Pixels": ("--generator-weight", "--n-lights"),
        "Length": ("--steps", "--minutes", "--resume"),
        "Output": ("--output", "--tensorboard", "--quiet"),
        "Speed": ("--device",),
    },
    "import-weights": {"Output": ("--output", *REPEAT)},
}
"""Command -> title of a panel -> its options, in the order of the help."""

OTHERS = "Options"
"""Title of the options that no panel names, such as --help."""


def sort_into_panels(command: str, options: list[str]) -> dict[str, list[str]]:
    """Return the title of each panel and those of the options (their long names) that stand in it."""
    panels = {title: [name for name in names if name in options] for title, names in PANELS.get(command, {}).items()}
    named = {name for names in panels.values() for name in names}
    panels[OTHERS] = [name for name in options if name not in named]
    return {title: names for title, names in panels.items() if names}
