"""Options of the panel Output: what is written, where, and what is printed."""

from __future__ import annotations

from pathlib import Path

from typer import Option

from splinecli.cli import choices
from splinecli.cli.options.values import NormalConvention, complete_list
from splinecli.surface.surface_files import DEFAULT_FORMATS, SURFACE_FILES
from splinecli.training.defaults import CHECKPOINT_SECONDS

# The place of the results.

INFER_FOLDER = Option(Path("out"), "--output", "-o", metavar="OUT", help="Write results to OUT/<capture name>/.")
CALIBRATION_FOLDER = Option(Path("calibration"), "--output", "-o", metavar="OUT", help="Folder of the results.")
SURFACE_FOLDER = Option(None, "--output", "-o", metavar="OUT", help="Folder of the results. [default: that of NORMALS]")
EVALUATION_FOLDER = Option(Path("evaluation"), "--output", "-o", metavar="OUT", help="Folder of the results.")
PIXEL_SET = Option(..., "--output", "-o", metavar="SET", help="Folder of the pixel set.")
RUN = Option(
    ...,
    "--output",
    "-o",
    metavar="RUN",
    help=f"Folder of the run. Its files are updated every {CHECKPOINT_SECONDS} seconds.",
)
WEIGHT_FILE = Option(..., "--output", "-o", metavar="FILE.safetensors", help="The weight file to write.")

# What is written.

NORMAL_FORMATS = Option(
    "png,npy",
    "--format",
    metavar="LIST",
    help="Files of the normal map: any of {formats}. png has 16 bits, png8 has 8, npy and tiff are float32."
    " With exr (needs the extra 'exr'), albedo and depth are written as EXR, too.",
    autocompletion=complete_list(choices.normal_formats),
)
SURFACE_FORMATS = Option(
    ",".join(DEFAULT_FORMATS),
    "--format",
    metavar="LIST",
    help=f"Files to write, any of {', '.join(SURFACE_FILES)}: meshes, and depth maps in float32 or"
    " as a 16-bit picture (png). exr needs the extra 'exr'.",
    autocompletion=complete_list(*SURFACE_FILES),
)
MAPS = Option(
    None,
    metavar="LIST",
    help="Further maps to write: any of {maps}. preview is a shaded image.",
    autocompletion=complete_list(choices.maps),
)
HTML = Option(
    False,
    "--html",
    help="Also write page.html: the maps, and a view of the surface under a light that you move.",
)
SURFACE = Option(
    False,
    "--surface",
    help="Also write mesh.glb, mesh.ply, and depth.npy, .tiff and .png, as integrate does.",
)
DECIMATE = Option(
    None,
    metavar="N",
    help="Reduce the mesh to N triangles; a texture of the normals keeps the detail in GLB (needs the extra 'mesh')."
    " [default: all]",
)
CONVENTION = Option(NormalConvention.opengl, help="Green channel of the PNG files: opengl is y up, directx is y down.")
LIGHT_PLOT = Option(None, metavar="FILE", help="Also plot the light directions to a PNG file.")
MENDED_LIGHTS = Option(
    None,
    metavar="FILE",
    help="Write the light directions in the order and frame that fit the images best, if the light file does not.",
)
COMPARE = Option(None, metavar="FILE", help="Compare the result with the light directions in a text file.")
FIGURES = Option(False, "--figures", help="Draw every method's maps for the first draw of each capture.")
FIGURE_PIXELS = Option(
    None,
    metavar="ROW,COLUMN",
    help="With --figures: show the observation maps of this pixel. May be repeated.",
)
TENSORBOARD = Option(False, "--tensorboard", help="Also write RUN/tensorboard (needs the extra 'tensorboard').")

# What happens to earlier results.

OVERWRITE = Option(False, "--overwrite", help="Replace earlier results.")
OVERWRITE_FILE = Option(False, "--overwrite", help="Replace an existing file.")
OVERWRITE_PLOT = Option(False, "--overwrite", help="Replace an earlier plot or file of lights.")
OVERWRITE_TRIALS = Option(False, "--overwrite", help="Compute all trials again, also those stored in OUT.")
UPDATE = Option(False, "--update", help="Compute changed captures again, and skip those that are done.")

STRICT = Option(
    False,
    "--strict",
    help="Fail (exit code 3) where a warning says that the lights or the images are probably wrong.",
)

# What is printed.

JSON = Option(False, "--json", help="Print one JSON document on stdout, and nothing else.")
JSON_LIST = Option(False, "--json", help="Print a JSON list of the reports on stdout, and nothing else.")
JSON_LINES = Option(False, "--jsonl", help="Print each report as one line of JSON on stdout when its capture ends.")
QUIET = Option(False, "--quiet", "-q", help="Print nothing but errors.")
