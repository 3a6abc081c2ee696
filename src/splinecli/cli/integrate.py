"""`splinecli integrate`: a normal map -> depth map and mesh."""

from __future__ import annotations

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import computing, inputs, outputs
from splinecli.cli.options.values import NormalConvention, split_commas
from splinecli.pipeline.integrate import IntegrateOptions, integrate_normal_map, summary_line
from splinecli.surface.surface_files import DEFAULT_FORMATS, SURFACE_FILES

_DEFAULT_FORMATS = ",".join(DEFAULT_FORMATS)


def integrate(
    normals: inputs.Normals,
    mask: inputs.NormalsMask = None,
    camera_matrix: inputs.CameraMatrix = None,
    convention: inputs.NormalsConvention = NormalConvention.opengl,
    colours: inputs.Colours = None,
    stiffness: computing.Stiffness = 2.0,
    largest_step: computing.LargestStep = None,
    output: outputs.SurfaceFolder = None,
    formats: outputs.SurfaceFormats = _DEFAULT_FORMATS,
    overwrite: outputs.Overwrite = False,
    as_json: outputs.Json = False,
    quiet: outputs.Quiet = False,
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
    print_report(report, summary_line(options, report), as_json=as_json, quiet=quiet)
