"""The man page, made from the commands themselves: `python -m splinecli.cli.man > man/splinecli.1`."""

from __future__ import annotations

import inspect
import sys
from typing import Any

import typer

from splinecli import __version__
from splinecli.cli.app import app

EXIT_STATUS = (
    ("0", "Done."),
    ("1", "A defect of splinecli."),
    ("2", "The command line cannot be meant this way."),
    ("3", "Bad input data; with several captures, at least one was passed over."),
    ("4", "Weights, a checkpoint or a configuration cannot be used."),
    ("5", "An output cannot be written, or exists and --overwrite was not given."),
    ("130", "Interrupted; nothing half-written is left behind."),
)
FILES = (
    ("CAPTURE/*.png, *.tif, *.jpg", "Images, linear, in natural order or in that of filenames.txt."),
    ("CAPTURE/light_directions.txt", "A line x y z for each image: x right, y up, z to the camera."),
    ("CAPTURE/light_intensities.txt", "A line r g b for each image. Optional."),
    ("CAPTURE/mask.png", "Bright on the object. Optional: without it every pixel counts."),
    ("CAPTURE/Normal_gt.mat", "True normals. Optional; errors are reported against them."),
    ("CAPTURE/*.lp, lights.json", "Instead: lights with the name of their image, of RTI or AliceVision."),
    ("OUT/NAME/normals.png", "Normal map, 16-bit RGB, (n + 1) / 2."),
    ("OUT/NAME/normals.npy", "Normal map, float32, H x W x 3, zero outside the mask."),
    ("OUT/NAME/error_map.png", "Angular error with a colour bar, where there is ground truth."),
    (
        "OUT/NAME/report.json",
        "What was done, with which weights, how long it took, how large the errors are.",
    ),
)
ENVIRONMENT = (
    ("COLUMNS", "Width of the help texts and tables."),
    ("NO_COLOR", "Set to anything: no colour on the terminal."),
    ("OMP_NUM_THREADS", "Number of processor threads of the networks."),
    ("CUDA_VISIBLE_DEVICES", "Which GPUs --device auto and cuda may use."),
)
EXAMPLES = (
    ("splinecli infer obj/ --lights l.txt", "Normals of one object from all its images."),
    ("splinecli infer catPNG --n-lights 10 --seed 0 --json", "From ten lights, the report on stdout."),
    ("splinecli infer captures/* -o results --overwrite", "A folder of captures."),
    ("splinecli calibrate chrome/ -o lights", "Light directions from photographs of a mirror ball."),
    ("splinecli integrate results/cat", "Depth and mesh of a normal map that infer wrote."),
    (
        "splinecli evaluate pmsData --method ls --method spline-net --n-lights 10 --trials 20",
        "Methods compared.",
    ),
    ("splinecli prepare --scenes 6 -o set", "A pixel set of six rendered scenes in three materials."),
    ("splinecli train set --preset compact --steps 300 -o run", "A short training on it."),
    (
        "splinecli train -o runs/mine --minutes 90",
        "New weights; then --weights runs/mine/weights.safetensors.",
    ),
    (
        "splinecli import-weights 200000-G.ckpt 200000-D.ckpt -o official.safetensors",
        "The authors' own weights; then --weights official.safetensors.",
    ),
)


def man_page() -> str:
    """The page in the man macros, every command with its options."""
    group: Any = typer.main.get_command(app)
    context = group.context_class(group, info_name="splinecli")
    lines = [
        f'.TH SPLINECLI 1 "" "splinecli {__version__}" "User Commands"',
        ".SH NAME",
        "splinecli \\- surface normals from a few photographs under known lights",
        ".SH SYNOPSIS",
    ]
    commands = {name: group.get_command(context, name) for name in group.list_commands(context)}
    contexts = {
        name: command.context_class(command, info_name=name, parent=context)
        for name, command in commands.items()
    }
    for name, command in commands.items():
        lines += [
            f".B splinecli {name}",
            _escape(" ".join(command.collect_usage_pieces(contexts[name]))),
            ".br",
        ]
    lines += [".SH DESCRIPTION", _escape(group.help), ".SH COMMANDS"]
    for name, command in commands.items():
        lines += [f".SS {name}"]
        for paragraph in inspect.cleandoc(command.help).split("\n\n"):
            lines += [_escape(" ".join(paragraph.split())), ".PP"]
        for parameter in command.get_params(contexts[name]):
            record = parameter.get_help_record(contexts[name])
            if record:
                lines += _entry(*record)
    for title, rows in (("EXIT STATUS", EXIT_STATUS), ("FILES", FILES), ("ENVIRONMENT", ENVIRONMENT)):
        lines.append(f".SH {title}")
        for row in rows:
            lines += _entry(*row)
    lines.append(".SH EXAMPLES")
    for command_line, meaning in EXAMPLES:
        lines += [_escape(meaning), ".PP", ".nf", ".RS", _escape(command_line), ".RE", ".fi", ".PP"]
    return "\n".join(lines) + "\n"


def _entry(term: str, meaning: str) -> list[str]:
    return [".TP", f"\\fB{_escape(term)}\\fR", _escape(" ".join(meaning.split()))]


def _escape(text: str) -> str:
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{text}" if text[:1] in ".'" else text


if __name__ == "__main__":
    sys.stdout.write(man_page())
