"""Make the man pages and docs/reports.schema.json from the commands and documents;
docs/generate.py runs this with the other generators.
"""

import inspect
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer

from splinecli import __version__
from splinecli.cli.help import EXAMPLES, examples_of, help_panels, wrap_example
from splinecli.cli.main import app
from splinecli.records.documents import json_schema
from splinecli.records.output_files import MAPS

EXIT_STATUS = {
    "0": "Done.",
    "1": "A defect of splinecli.",
    "2": "Usage: an option is wrong, or options cannot be used together.",
    "3": "Bad input data.",
    "4": "Weights, a checkpoint or a configuration cannot be used.",
    "5": "An output cannot be written, or exists and neither --overwrite nor --update was given.",
    "130": "Interrupted. No file is incomplete.",
}
FILES = {
    "CAPTURE/*.png, *.tif, *.jpg, *.dng,"
    " *.nef, ...": "Linear images, in natural order or in the order of"
    " filenames.txt. Camera RAW files need 'splinecli[raw]'.",
    "CAPTURE/light_directions.txt": "A line x y z for each image: x right, y up, z to the camera.",
    "CAPTURE/*.lp,"
    " lights.json": "Instead: lights with the names of their images, from RTI or AliceVision.",
    "CAPTURE/light_positions.txt,"
    " pixel_size.txt": "Near lamps: positions from the middle of the image on the object,"
    " and the width of a pixel in their unit. Optional.",
    "CAPTURE/camera_matrix.txt": "The camera matrix in pixels. Optional: without it, the camera"
    " is orthographic.",
    "CAPTURE/light_intensities.txt": "A line r g b for each image. Optional.",
    "CAPTURE/mask.png": "White on the object (above half of its largest value). Optional:"
    " without it, every pixel belongs to the object.",
    "CAPTURE/ambient.png": "The object with the lamp off, subtracted from all images. Optional.",
    "CAPTURE/Normal_gt.mat": "True normals. Optional: with them, errors are reported.",
    "OUT/NAME/normals.png": "Normal map, 16-bit RGB, (n + 1) / 2.",
    "OUT/NAME/normals.npy": "Normal map, float32, H x W x 3, zero outside the mask.",
    "OUT/NAME/normals_8bit.png,"
    " normals.tiff, normals.exr": "With --format png8, tiff, exr: normal map in 8 bits, in"
    " float32, in float32 for renderers. tiff and exr also write the maps below in these formats,"
    " exr depth.exr.",
    "OUT/NAME/error_map.png": "If there are true normals: angular error with a color bar.",
    "OUT/NAME/capture.png": "Contact sheet of the images, each with its light, and of the mask.",
    "OUT/NAME/mended_lights.txt": "If they were corrected: the light directions that were used.",
    "OUT/NAME/found_mask.png": "With --auto-mask: the mask of the object.",
    **{
        f"OUT/NAME/{', '.join(each.files.values())}": f"With --maps {each.name}: {each.content}."
        for each in MAPS.values()
    },
    "OUT/frames/NAME": "The frames of a video, a capture of its own.",
    "OUT/NAME/mesh.glb, mesh.ply, depth.npy,"
    " depth.tiff, depth.png": "With --surface, or from splinecli integrate"
    " OUT/NAME, which also writes surface.json and, with --level, level_normals.npy and"
    " level_normals.png. Both can write mesh.obj (with mesh.mtl, mesh.png, mesh_roughness.png and"
    " mesh_metalness.png), mesh.stl and mesh.3mf.",
    "OUT/NAME/page.html": "With --html: all pictures, and the surface under a light that"
    " follows the pointer.",
    "OUT/NAME/report.json": "Lights, method, weights, options, time, warnings and errors.",
    "OUT/index.html": "With several captures: links to all results.",
}
ENVIRONMENT = {
    "COLUMNS": "Width of help texts and tables.",
    "NO_COLOR": "If set, the terminal output has no colors.",
    "OMP_NUM_THREADS": "Number of processor threads of the networks.",
    "CUDA_VISIBLE_DEVICES": "GPUs that --device auto and cuda may use.",
}


def man_pages() -> dict[str, str]:
    """Return file name -> man page, for splinecli and each command."""
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
        *_beginning(
            "splinecli", "surface normals from a few photographs under known lights", group, context
        ),
        ".SH OPTIONS",
        *_options({"Options": help_panels(group, context)["Options"]}),
        ".SH COMMANDS",
    ]
    for name, command in commands.items():
        lines += [".TP", _reference(name), _escape(_paragraphs(command.help)[0])]
    for title, rows in (
        ("EXIT STATUS", EXIT_STATUS),
        ("FILES", FILES),
        ("ENVIRONMENT", ENVIRONMENT),
    ):
        lines.append(f".SH {title}")
        for term, meaning in rows.items():
            lines += [".TP", f"\\fB{_escape(term)}\\fR", _escape(meaning)]
    return _page_text([*lines, *_examples("")], commands)


def _command_page(name: str, command: Any, context: Any, commands: dict[str, Any]) -> str:
    summary = _paragraphs(command.help)[0].rstrip(".")
    lines = [
        # The section NAME takes a phrase: no capital letter, no full stop.
        *_beginning(_page_name(name), summary[0].lower() + summary[1:], command, context),
        ".SH OPTIONS",
        *_options(help_panels(command, context)),
        ".SH EXIT STATUS",
        "0 if everything is done. The other codes are listed in",
        ".BR splinecli (1).",
        *_examples(name),
    ]
    # Commands that this page mentions.
    text = " ".join([command.help, *(parameter.help or "" for parameter in command.params)])
    related = [other for other in commands if other != name and re.search(rf"\b{other}\b", text)]
    return _page_text(lines, ["", *related])


def _beginning(title: str, meaning: str, command: Any, context: Any) -> list[str]:
    """Return the page's head, name, synopsis and description."""
    usage = " ".join(command.collect_usage_pieces(context))
    return [
        f'.TH {_escape(title.upper())} 1 "" "splinecli {__version__}" "User Commands"',
        # Do not hyphenate file names, and do not stretch lines.
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
    lines = []
    for title, rows in panels.items():
        if len(panels) > 1:
            lines.append(f".SS {_escape(title)}")
        for term, meaning in rows:
            # Bold for what is typed as it stands, italic for what stands for something.
            words = [
                rf"\f{'B' if word[0] == '-' else 'I'}{_escape(word)}\fR" for word in term.split()
            ]
            lines += [".TP", " ".join(words), _escape(meaning)]
    return lines


def _examples(name: str) -> list[str]:
    """Return the examples of a command, or all for an empty name."""
    lines = [".SH EXAMPLES"]
    for command_line, meaning in (examples_of(name) if name else EXAMPLES).items():
        lines += [_escape(meaning), ".PP", ".RS", ".nf", _escape(wrap_example(command_line))]
        lines += [".fi", ".RE", ".PP"]
    return lines[:-1]  # the next section starts its own paragraph


def _page_text(lines: list[str], related: Iterable[str]) -> str:
    return "\n".join([*lines, ".SH SEE ALSO", ",\n".join(map(_reference, related))]) + "\n"


def _page_name(command: str) -> str:
    return f"splinecli-{command}" if command else "splinecli"


def _reference(command: str) -> str:
    return f".BR {_escape(_page_name(command))} (1)"


def _paragraphs(text: str) -> list[str]:
    return [" ".join(paragraph.split()) for paragraph in inspect.cleandoc(text).split("\n\n")]


# Without escapes, groff turns these into typographic hyphens, quotes and accents.
_PLAIN = str.maketrans(
    {"\\": "\\e", "-": "\\-", "'": "\\(aq", "`": "\\(ga", "^": "\\(ha", "~": "\\(ti"}
)


def _escape(text: str) -> str:
    text = text.translate(_PLAIN)
    return f"\\&{text}" if text.startswith(".") else text


if __name__ == "__main__":
    for page, text in man_pages().items():
        (Path(__file__).parent / page).write_text(text, "utf-8")
    schema = Path(__file__).parents[1] / "docs/reports.schema.json"
    schema.write_text(json.dumps(json_schema(), indent=2) + "\n", "utf-8")
