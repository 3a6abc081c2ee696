"""`splinecli integrate`: a normal map -> depth map and mesh."""

from __future__ import annotations

from pathlib import Path

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import computing, inputs, outputs
from splinecli.cli.options.values import NormalConvention, split_commas
from splinecli.cli.records import record_from
from splinecli.pipeline.integrate import IntegrateOptions, integrate_normal_map, summary_line
from splinecli.surface.surface_files import SURFACE_FILES


def integrate(
    normals: Path = inputs.NORMALS,
    mask: Path | None = inputs.NORMALS_MASK,
    camera_matrix: Path | None = inputs.CAMERA_MATRIX,
    convention: NormalConvention | None = inputs.NORMALS_CONVENTION,
    colours: Path | None = inputs.COLOURS,
    stiffness: float = computing.STIFFNESS,
    prior: Path | None = inputs.PRIOR,
    prior_detail: float | None = computing.PRIOR_DETAIL,
    largest_step: float | None = computing.LARGEST_STEP,
    pixel_size: float | None = inputs.PIXEL_SIZE_MM,
    output: Path | None = outputs.SURFACE_FOLDER,
    formats: str = outputs.SURFACE_FORMATS,
    decimate: int | None = outputs.DECIMATE,
    overwrite: bool = outputs.OVERWRITE,
    as_json: bool = outputs.JSON,
    quiet: bool = outputs.QUIET,
) -> None:
    """Integrate a normal map to a depth map and a mesh.

    Uses bilateral normal integration. The surface may break at edges, where the normals do not fit together. Without a
    camera matrix, the depth map has heights towards the camera in pixels, with mean zero. With one, it has depths
    along the viewing axis, of unknown scale.

    Writes OUT/mesh.glb and mesh.ply (or .obj, .stl), depth.npy and depth.tiff, which are NaN outside the object,
    depth.png and surface.json.
    """
    options = record_from(
        IntegrateOptions,
        locals(),
        formats=tuple(split_commas(formats, "--format", list(SURFACE_FILES))),
    )
    report = integrate_normal_map(options, Messages(quiet=quiet))
    print_report(report, summary_line(options, report), as_json=as_json, quiet=quiet)
