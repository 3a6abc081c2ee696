"""`splinecli integrate`: a normal map -> depth map and mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import (
    JsonOption,
    NormalConvention,
    OverwriteOption,
    QuietOption,
    complete_list,
    split_commas,
)
from splinecli.pipeline.integrate import IntegrateOptions, integrate_normal_map, summary_line
from splinecli.surface.surface_files import DEFAULT_FORMATS, SURFACE_FILES


def integrate(
    normals: Annotated[
        Path,
        typer.Argument(
            metavar="NORMALS", help="Normal map (.npy, .png, .tif, .mat), or a folder that infer wrote."
        ),
    ],
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Mask image: non-zero pixels belong to the object. [default: all pixels that have a normal]",
        ),
    ] = None,
    camera_matrix: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Text file of the 3 x 3 camera matrix in pixels, for a perspective camera."
            " [default: orthographic]",
        ),
    ] = None,
    convention: Annotated[
        NormalConvention,
        typer.Option(
            help="Green channel of a normal map that is an image: opengl is y up, directx is y down."
        ),
    ] = NormalConvention.opengl,
    colours: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Image that gives the colours of the mesh, such as an albedo map."),
    ] = None,
    stiffness: Annotated[
        float,
        typer.Option(metavar="K", min=0, help="How easily the surface tears at edges. 0 never tears it."),
    ] = 2.0,
    largest_step: Annotated[
        float | None,
        typer.Option(
            metavar="PIXELS",
            min=0,
            help="Leave out triangles whose corners differ more in height. [default: keep all]",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="OUT", help="Folder of the results. [default: that of NORMALS]"
        ),
    ] = None,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="LIST",
            help=f"Files to write, any of {', '.join(SURFACE_FILES)}: meshes, and depth maps in float32.",
            autocompletion=complete_list(*SURFACE_FILES),
        ),
    ] = ",".join(DEFAULT_FORMATS),
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Integrate a normal map to a depth map and a mesh.

    Bilateral normal integration: the surface may tear at edges, where the normals do not fit together. Without a
    camera matrix, the depth map has heights towards the camera in pixels, with mean zero. With one, it has depths
    along the viewing axis, of unknown scale.

    Writes OUT/mesh.ply (or .obj), depth.npy and depth.tiff, which are NaN outside the object, and surface.json.
    """
    options = IntegrateOptions(
        normals=normals,
        output=output,
        mask=mask,
        camera_matrix=camera_matrix,
        stiffness=stiffness,
        largest_step=largest_step,
        colours=colours,
        formats=tuple(split_commas(formats, "--format", list(SURFACE_FILES))),
        convention=convention.value,
        overwrite=overwrite,
    )
    report = integrate_normal_map(options, Messages(quiet=quiet))
    if as_json:
        print(json.dumps(report, indent=2))
    elif not quiet:
        print(summary_line(options, report))
