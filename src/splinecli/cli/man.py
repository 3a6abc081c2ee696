"""The man pages, one of the whole and one a command, made from the commands: `python -m splinecli.cli.man man`."""

from __future__ import annotations

import inspect
import re
import shlex
import sys
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer

from splinecli import __version__
from splinecli.cli.app import app
from splinecli.cli.commands import help_panels

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
    (
        "CAPTURE/*.png, *.tif, *.jpg, *.dng, *.nef, ...",
        "Images, linear, in natural order or in that of filenames.txt. Cameras' RAW files need 'splinecli[raw]'.",
    ),
    ("CAPTURE/light_directions.txt", "A line x y z for each image: x right, y up, z to the camera."),
    ("CAPTURE/*.lp, lights.json", "Instead: lights with the name of their image, of RTI or AliceVision."),
    ("CAPTURE/light_intensities.txt", "A line r g b for each image. Optional."),
    ("CAPTURE/mask.png", "Bright on the object. Optional: without it every pixel counts."),
    ("CAPTURE/ambient.png", "The object under none of the lights, to be taken off all images. Optional."),
    ("CAPTURE/Normal_gt.mat", "True normals. Optional; errors are reported against them."),
    ("OUT/NAME/normals.png", "Normal map, 16-bit RGB, (n + 1) / 2."),
    ("OUT/NAME/normals.npy", "Normal map, float32, H x W x 3, zero outside the mask."),
    ("OUT/NAME/normals_8bit.png, normals.tiff", "With --format png8, tiff: the same in 8 bits, in float32."),
    ("OUT/NAME/error_map.png", "Angular error with a colour bar, where there is ground truth."),
    ("OUT/NAME/found_mask.png", "With --auto-mask: the mask that was found."),
    ("OUT/NAME/albedo.png, albedo.npy", "With --maps albedo: the picture, and linear in float32."),
    (
        "OUT/NAME/confidence.png, confidence.npy",
        "With --maps confidence: the probability that a normal is off by 5 degrees at most, gray and in float32.",
    ),
    ("OUT/NAME/preview.png", "With --maps preview: the surface, matte white, under a raking light."),
    (
        "OUT/NAME/mesh.ply, depth.npy, depth.tiff",
        "With --surface, or of splinecli integrate OUT/NAME, which writes surface.json and can write mesh.obj too.",
    ),
    ("OUT/NAME/page.html", "With --html: the pictures, and a view under a light that follows the pointer."),
    (
        "OUT/NAME/report.json",
        "What was done, with which weights, how long it took, how large the errors are.",
    ),
    ("OUT/index.html", "Of several captures: all of them at a glance."),
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
    ("splinecli infer obj/ --auto-mask --maps albedo,preview --surface --html", "Much to look at."),
    ("splinecli info obj/", "What infer would read, before it is run."),
    (
        "splinecli info obj/ --transfer srgb --plot lights.png",
        "The lights drawn; of images made for a screen.",
    ),
    ("splinecli calibrate chrome/ -o lights", "Light directions from photographs of a mirror ball."),
    (
        "splinecli calibrate chrome/ --circle 512,384,200 --gray-ball gray/ -o lights",
        "With a given outline of the ball, and with light intensities.",
    ),
    ("splinecli integrate results/cat", "Depth and mesh of a normal map that infer wrote."),
    (
        "splinecli integrate normals.png --mask mask.png --format obj -o surface",
        "A mesh of a normal map from elsewhere.",
    ),
    (
        "splinecli evaluate pmsData --method ls --method spline-net --n-lights 10 --trials 20",
        "Methods compared.",
    ),
    (
        "splinecli evaluate pmsData --method all --n-lights 5 --n-lights 10 --trials 20 --figures",
        "All of them, with two numbers of lights, and with pictures.",
    ),
    ("splinecli prepare --scenes 6 -o set", "A pixel set of six rendered scenes in three materials."),
    ("splinecli prepare PRPS PRPS_Diffuse -o cycles", "A pixel set of the CyclesPS data."),
    ("splinecli train set --preset compact --steps 300 -o run", "A short training on a pixel set."),
    (
        "splinecli train -o runs/mine --minutes 90",
        "New weights; then --weights runs/mine/weights.safetensors.",
    ),
    ("splinecli train -o runs/mine --resume", "Going on after an interruption."),
    (
        "splinecli import-weights 200000-G.ckpt 200000-D.ckpt -o official.safetensors",
        "The authors' own weights; then --weights official.safetensors.",
    ),
)
EXAMPLE_WIDTH = 64
"""Columns that an example may fill: with its indent a line of a terminal of 80."""


def man_pages() -> dict[str, str]:
    """Name of the file -> the page in the man macros, of splinecli and of each command."""
    group: Any = typer.main.get_command(app)
    context = group.context_class(group, info_name="splinecli", **group.context_settings)
    commands = {name: group.get_command(context, name) for name in group.list_commands(context)}
    pages = {"splinecli.1": _overview(group, context, commands)}
    for name, command in commands.items():
        own_context = command.context_class(command, info_name=name, parent=context)
        pages[f"{_page_name(name)}.1"] = _command_page(name, command, own_context, commands)
    return pages


def _overview(group: Any, context: Any, commands: dict[str, Any]) -> str:
    lines = [
        *_beginning("splinecli", "surface normals from a few photographs under known lights", group, context),
        ".SH OPTIONS",
        *_options(help_panels(group, context)),
        ".SH COMMANDS",
    ]
    for name, command in commands.items():
        lines += [".TP", _reference(name), _escape(_paragraphs(command.help)[0])]
    for title, rows in (("EXIT STATUS", EXIT_STATUS), ("FILES", FILES), ("ENVIRONMENT", ENVIRONMENT)):
        lines.append(f".SH {title}")
        for term, meaning in rows:
            lines += [".TP", f"\\fB{_escape(term)}\\fR", _escape(meaning)]
    return _page_text([*lines, *_examples(""), *_see_also(commands)])


def _command_page(name: str, command: Any, context: Any, commands: dict[str, Any]) -> str:
    summary = _paragraphs(command.help)[0].rstrip(".")
    lines = [
        # In NAME stands no sentence: no capital, no full stop.
        *_beginning(_page_name(name), summary[0].lower() + summary[1:], command, context),
        ".SH OPTIONS",
        *_options(help_panels(command, context)),
        ".SH EXIT STATUS",
        "0 if everything is done. The other codes are listed in",
        ".BR splinecli (1).",
        *_examples(name),
    ]
    # The other commands that this one's texts speak of.
    text = " ".join([command.help, *(parameter.help or "" for parameter in command.params)])
    related = [other for other in commands if other != name and re.search(rf"\b{other}\b", text)]
    return _page_text([*lines, *_see_also(["", *related])])


def _beginning(title: str, meaning: str, command: Any, context: Any) -> list[str]:
    """All up to and with the description."""
    usage = " ".join(command.collect_usage_pieces(context))
    return [
        f'.TH {_escape(title.upper())} 1 "" "splinecli {__version__}" "User Commands"',
        # No hyphens in names of files, no gaps between words.
        ".nh",
        ".ad l",
        ".SH NAME",
        f"{_escape(title)} \\- {_escape(meaning)}",
        ".SH SYNOPSIS",
        f".B {_escape(context.command_path)}",
        _escape(usage),
        ".SH DESCRIPTION",
        *"\n.PP\n".join(map(_escape, _paragraphs(command.help))).split("\n"),
    ]


def _options(panels: dict[str, list[tuple[str, str]]]) -> list[str]:
    """Write the rows of a command's help, with a heading for each panel if there are several."""
    lines = []
    for title, rows in panels.items():
        if len(panels) > 1:
            lines.append(f".SS {_escape(title)}")
        for term, meaning in rows:
            # Bold for what is typed as it stands, italic for what stands for something.
            words = [rf"\f{'B' if word[0] == '-' else 'I'}{_escape(word)}\fR" for word in term.split()]
            lines += [".TP", " ".join(words), _escape(meaning)]
    return lines


def _examples(name: str) -> list[str]:
    """Those of a command, or all."""
    lines = [".SH EXAMPLES"]
    for command_line, meaning in EXAMPLES:
        if name in ("", shlex.split(command_line)[1]):
            lines += [_escape(meaning), ".PP", ".RS", ".nf", _escape(_wrap(command_line))]
            lines += [".fi", ".RE", ".PP"]
    return lines[:-1]  # no new paragraph before the next section


def _wrap(command_line: str) -> str:
    """The command on several lines where it is long, an option beside its value."""
    whole = re.sub(r"( -\S+) (?!-)", "\\1\0", command_line)
    lines = textwrap.wrap(whole, EXAMPLE_WIDTH, break_long_words=False, break_on_hyphens=False)
    return " \\\n    ".join(lines).replace("\0", " ")


def _see_also(names: Iterable[str]) -> list[str]:
    return [".SH SEE ALSO", *(f"{_reference(name)}," for name in names)]


def _page_text(lines: list[str]) -> str:
    return "\n".join(lines).rstrip(",") + "\n"


def _page_name(command: str) -> str:
    return f"splinecli-{command}" if command else "splinecli"


def _reference(command: str) -> str:
    return f".BR {_escape(_page_name(command))} (1)"


def _paragraphs(text: str) -> list[str]:
    return [" ".join(paragraph.split()) for paragraph in inspect.cleandoc(text).split("\n\n")]


# Bare, these would be typeset: hyphens, curly quotes, accents.
_PLAIN = str.maketrans({"\\": "\\e", "-": "\\-", "'": "\\(aq", "`": "\\(ga", "^": "\\(ha", "~": "\\(ti"})


def _escape(text: str) -> str:
    text = text.translate(_PLAIN)
    return f"\\&{text}" if text.startswith(".") else text


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    for page, text in man_pages().items():
        (folder / page).write_text(text, "utf-8")
