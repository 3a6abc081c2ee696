"""Options of the panel Output: what is written, where, and what is printed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

from splinecli.cli import choices
from splinecli.cli.options.values import NormalConvention, complete_list
from splinecli.surface.surface_files import SURFACE_FILES
from splinecli.training.defaults import CHECKPOINT_SECONDS

# The place of the results.

InferFolder = Annotated[
    Path, Option("--output", "-o", metavar="OUT", help="Write results to OUT/<capture name>/.")
]
CalibrationFolder = Annotated[Path, Option("--output", "-o", metavar="OUT", help="Folder of the results.")]
SurfaceFolder = Annotated[
    Path | None,
    Option("--output", "-o", metavar="OUT", help="Folder of the results. [default: that of NORMALS]"),
]
EvaluationFolder = Annotated[Path, Option("--output", "-o", metavar="OUT", help="Folder for the results.")]
PixelSet = Annotated[Path, Option("--output", "-o", metavar="SET", help="Folder of the pixel set.")]
Run = Annotated[
    Path,
    Option(
        "--output",
        "-o",
        metavar="RUN",
        help=f"Folder of the run. Its files are renewed every {CHECKPOINT_SECONDS} seconds.",
    ),
]
WeightFile = Annotated[
    Path, Option("--output", "-o", metavar="FILE.safetensors", help="The weight file to write.")
]

# What is written.

NormalFormats = Annotated[
    str,
    Option(
        "--format",
        metavar="LIST",
        help="Files of the normal map: any of {formats}. png has 16 bits, png8 has 8, npy and tiff are float32.",
        autocompletion=complete_list(choices.normal_formats),
    ),
]
SurfaceFormats = Annotated[
    str,
    Option(
        "--format",
        metavar="LIST",
        help=f"Files to write, any of {', '.join(SURFACE_FILES)}: meshes, and depth maps in float32.",
        autocompletion=complete_list(*SURFACE_FILES),
    ),
]
Maps = Annotated[
    str | None,
    Option(
        metavar="LIST",
        help="Further maps to write: any of {maps} (a shaded image).",
        autocompletion=complete_list(choices.maps),
    ),
]
Html = Annotated[
    bool, Option("--html", help="Also write page.html: images and a view under a movable light.")
]
Surface = Annotated[
    bool, Option("--surface", help="Also write mesh.ply, depth.npy and depth.tiff, as integrate does.")
]
Convention = Annotated[
    NormalConvention, Option(help="Green channel of the PNG files: opengl is y up, directx is y down.")
]
LightPlot = Annotated[
    Path | None, Option(metavar="FILE", help="Also plot the light directions to a PNG file.")
]
Compare = Annotated[
    Path | None,
    Option(metavar="FILE", help="Compare the result with the light directions in a text file."),
]
Figures = Annotated[
    bool, Option("--figures", help="Draw every method's maps for the first draw of each capture.")
]
FigurePixels = Annotated[
    list[str] | None,
    Option(
        metavar="ROW,COLUMN",
        help="With --figures: show the observation maps of this pixel. May be repeated.",
    ),
]
Tensorboard = Annotated[
    bool, Option("--tensorboard", help="Also write RUN/tensorboard (needs the extra 'tensorboard').")
]

# What happens to earlier results.

Overwrite = Annotated[bool, Option("--overwrite", help="Replace earlier results.")]
OverwriteFile = Annotated[bool, Option("--overwrite", help="Replace an existing file.")]
OverwritePlot = Annotated[bool, Option("--overwrite", help="Replace an earlier plot.")]
OverwriteTrials = Annotated[bool, Option("--overwrite", help="Compute trials again that OUT already has.")]
Update = Annotated[bool, Option("--update", help="Redo captures that changed, skip those that are done.")]

# What is printed.

Json = Annotated[bool, Option("--json", help="Print one JSON document on stdout and nothing else.")]
JsonList = Annotated[
    bool, Option("--json", help="Print a JSON list of the reports on stdout, and nothing else.")
]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print nothing but errors.")]
