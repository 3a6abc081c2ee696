"""Which options stand together in the help of each command."""

from __future__ import annotations

PANELS = {
    "infer": {
        "Input": "mask auto-mask crop scale ground-truth transfer ambient flat-field white-level as-stored",
        "Lights": "lights first-light light-frame lights-format intensities refine-lights light-positions"
        " light-distance pixel-size object-width camera-matrix n-lights seed light-indices",
        "Method": "method weights",
        "Output": "output format maps html surface stiffness convention strict update overwrite json jsonl quiet",
        "Speed": "distil device precision",
        "Processes and machines": "workers cluster shard",
    },
    "watch": {"Captures": "marker settle"},
    "info": {
        "Input": "mask crop scale ground-truth transfer ambient flat-field white-level",
        "Lights": "lights first-light light-frame lights-format intensities light-positions light-distance pixel-size"
        " object-width camera-matrix check-lights mended-lights",
        "Output": "plot strict overwrite json quiet",
    },
    "calibrate": {
        "Input": "circle mask ball-diameter camera-matrix",
        "Light intensities": "gray-ball gray-card transfer",
        "Output": "output compare overwrite json quiet",
    },
    "integrate": {
        "Input": "mask camera-matrix pixel-size convention colours prior",
        "Method": "stiffness prior-detail largest-step",
        "Output": "output format decimate overwrite json quiet",
    },
    "evaluate": {
        "Input": "skip-first max-pixels as-stored white-level",
        "Lights": "lights n-lights trials seed draws light-noise-deg refine-lights light-error-deg",
        "Method": "method weights rotations",
        "Output": "output figures pixel overwrite json quiet",
        "Speed": "jobs device precision",
        "Processes and machines": "workers cluster",
    },
    "prepare": {
        "Input": "as-stored update white-level",
        "Scenes": "scenes mesh size n-lights seed",
        "Output": "output json quiet",
        "Speed": "workers",
    },
    "train": {
        "Settings": "preset config param start-from seed",
        "Pixels": "generator-weight n-lights",
        "Length": "steps minutes resume",
        "Output": "output tensorboard quiet",
        "Speed": "device",
    },
    "import-weights": {"Output": "output overwrite quiet"},
}
"""Command -> title of a panel -> its options, in the order of the help."""

OTHERS = "Options"  # title of the options that no panel names, such as --help


def sort_into_panels(command: str, options: list[str]) -> dict[str, list[str]]:
    """Return the title of each panel and those of the options (their long names) that stand in it."""
    panels = {
        title: [f"--{name}" for name in names.split() if f"--{name}" in options]
        for title, names in PANELS.get(command, {}).items()
    }
    named = {name for names in panels.values() for name in names}
    panels[OTHERS] = [name for name in options if name not in named]
    return {title: names for title, names in panels.items() if names}
