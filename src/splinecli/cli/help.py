"""The help of a command: its options by panel, and examples.

The man pages and the website use the same texts (man/make_pages.py, docs/site_pages.py).
"""

import os
import re
import shlex
import textwrap
from typing import Any

import typer

EXAMPLES = {
    "splinecli infer obj/ --lights"
    " l.txt": "Estimate the normals of one object from all its images.",
    "splinecli infer obj/ --auto-mask --maps albedo,preview"
    " --surface --html": "Also write albedo, preview, mesh and page.",
    "splinecli infer clip.mp4 --lights estimate --mask mask.png": "Use a video of a lamp that is"
    " carried around the object.",
    "splinecli infer captures/* -o results --overwrite": "Process a folder of captures.",
    "splinecli infer catPNG --n-lights 10 --seed 0 --json": "Use ten lights and print the report.",
    "splinecli watch parts/ -- --lights l.txt --jsonl": "Process each part as it arrives.",
    "splinecli info obj/": "Describe the capture as infer would read it.",
    "splinecli info obj/ --transfer srgb"
    " --plot lights.png": "Check sRGB images, and plot the light directions.",
    "splinecli calibrate chrome/ -o lights": "Measure light directions with a mirror ball.",
    "splinecli calibrate chrome/ --circle 512,384,200"
    " --gray-ball gray/ -o lights": "Give the outline of the ball, and"
    " also measure light intensities.",
    "splinecli integrate results/cat": "Make a depth map and a mesh from the results of infer.",
    "splinecli integrate normals.png --mask mask.png"
    " --format obj -o surface": "Make a mesh from any normal map.",
    "splinecli evaluate pmsData --method ls --method spline-net"
    " --n-lights 10 --trials 20": "Compare two methods.",
    "splinecli evaluate pmsData --method all --n-lights 5 --n-lights 10"
    " --trials 20 --figures": "Compare all methods"
    " with two numbers of lights, and draw their maps.",
    "splinecli prepare --scenes 6 -o set": "Render six scenes in three materials.",
    "splinecli prepare PRPS PRPS_Diffuse -o cycles": "Make a pixel set from the CyclesPS data.",
    "splinecli train set --preset compact --steps 300 -o run": "Train briefly on a pixel set.",
    "splinecli train -o runs/mine"
    " --minutes 90": "Train new weights, then use --weights runs/mine/weights.safetensors.",
    "splinecli train -o runs/mine --resume": "Continue after an interruption.",
    "splinecli import-weights 200000-G.ckpt 200000-D.ckpt -o"
    " official.safetensors": "Convert the authors' weights,"
    " then use --weights official.safetensors.",
}
"""Maps command lines to their descriptions."""

EXAMPLE_WIDTH = 64  # columns, so that an indented example fits into a terminal of 80 columns
_TERM_WIDTH = 26  # columns for an option and its value; longer ones are on a separate line


def examples_of(name: str) -> dict[str, str]:
    """Return the examples of a command."""
    return {line: words for line, words in EXAMPLES.items() if shlex.split(line)[1] == name}


def wrap_example(command_line: str) -> str:
    """Return a long command on several lines, keeping each option and its value on the same
    line.
    """
    whole = re.sub(r"( -\S+) (?!-)", "\\1\0", command_line)
    lines = textwrap.wrap(whole, EXAMPLE_WIDTH, break_long_words=False, break_on_hyphens=False)
    return " \\\n    ".join(lines).replace("\0", " ")


def help_panels(command: Any, context: Any) -> dict[str, list[tuple[str, str]]]:
    """Return the rows of each panel of a command's help, each with a name and its description."""
    panels: dict[str, list[tuple[str, str]]] = {}
    for parameter in command.get_params(context):
        if (record := parameter.get_help_record(context)) is None:
            continue
        term, meaning = record
        title = getattr(parameter, "rich_help_panel", None) or "Options"
        if parameter.param_type_name == "argument":
            title, term = "Arguments", parameter.metavar
            meaning = meaning.removesuffix("[required]")
        meaning = re.sub(r"\[default: \((.*)\)\]$", r"[default: \1]", meaning)
        panels.setdefault(title, []).append((" ".join(term.split()), " ".join(meaning.split())))
    if hasattr(command, "list_commands"):
        commands = {
            name: command.get_command(context, name) for name in command.list_commands(context)
        }
        panels["Commands"] = [
            (name, each.help.partition("\n")[0]) for name, each in commands.items()
        ]
    return panels


def write_help(command: Any, context: Any, formatter: Any) -> None:
    """Write the help of a command as text that fits the terminal, with bold titles."""

    def section(title: str) -> Any:
        return formatter.section(
            title if "NO_COLOR" in os.environ else typer.style(title, bold=True)
        )

    command.format_usage(context, formatter)
    command.format_help_text(context, formatter)
    for title, rows in help_panels(command, context).items():
        with section(title):
            column = 4 + min(_TERM_WIDTH, max(len(term) for term, _ in rows))
            for term, meaning in rows:
                text = textwrap.fill(meaning, formatter.width - column, break_on_hyphens=False)
                text = textwrap.indent(text, " " * column)
                fits = len(term) <= column - 4
                formatter.write(f"  {term}{text[2 + len(term) :] if fits else chr(10) + text}\n")
    if examples := examples_of(command.name):
        with section("Examples"):
            for line, words in examples.items():
                formatter.write_text(words)
                formatter.write(textwrap.indent(wrap_example(line), "    ") + "\n")
    command.format_epilog(context, formatter)
