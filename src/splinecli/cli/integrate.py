"""`splinecli integrate`: a normal map -> depth and mesh."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from splinecli.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FORMS = ("npy", "tiff", "png", "png8")
"""Of the normal maps that infer writes, the exact ones first."""


def integrate(
    normals: Annotated[
        Path,
        typer.Argument(
            metavar="NORMALS", help="Normal map (.npy, .png, .tif, .mat), or a folder that infer wrote."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="OUT", help="Folder of the results. [default: that of NORMALS]"
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Picture that is bright on the object. [default: where there are normals]"
        ),
    ] = None,
    camera_matrix: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="3 x 3 numbers in pixels, for a perspective camera. [default: orthographic]"
        ),
    ] = None,
    stiffness: Annotated[
        float, typer.Option(metavar="K", min=0, help="How readily the surface tears at edges; 0: never.")
    ] = 2.0,
    largest_step: Annotated[
        float | None,
        typer.Option(
            metavar="PIXELS", min=0, help="Leave out triangles that are higher. [default: keep all]"
        ),
    ] = None,
    colours: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Picture of the vertices' colours, such as an albedo map."),
    ] = None,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="LIST",
            help="Any of ply, obj (meshes), npy, tiff (float32 depth).",
            autocompletion=complete_list("ply", "obj", "npy", "tiff"),
        ),
    ] = "ply,npy,tiff",
    convention: Annotated[
        NormalConvention, typer.Option(help="Green of a picture: opengl is y up, directx is y down.")
    ] = NormalConvention.opengl,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Integrate a normal map to heights and a mesh.

    Bilateral normal integration: the surface may tear where the normals do not fit together. Heights are in pixels,
    towards the camera, zero in the mean; with a camera matrix, depths along the viewing axis of unknown scale. Writes
    OUT/mesh.ply (or .obj), depth.npy and depth.tiff (NaN outside the object), and surface.json.
    """
    import numpy as np

    from splinecli.capture import read_mask, read_normal_map
    from splinecli.files import check_free, write_text
    from splinecli.surface.integration import integrate_normals
    from splinecli.surface.mesh import surface_mesh
    from splinecli.surface.surface_files import SURFACE_FILES, SURFACE_REPORT, write_surface

    wanted = split_commas(formats, "--format", list(SURFACE_FILES))
    folder = output or (normals if normals.is_dir() else normals.parent)
    check_free(folder, (*(SURFACE_FILES[form] for form in wanted), SURFACE_REPORT), overwrite=overwrite)
    given = None if mask is None else read_mask(mask)
    path = _find_in(normals) if normals.is_dir() else normals
    normal_map = read_normal_map(path, given)
    if convention is NormalConvention.directx or (path != normals and _is_directx(path)):
        normal_map[..., 1] *= -1
    inside = np.asarray(normal_map.any(axis=2))
    matrix = None if camera_matrix is None else _read_matrix(camera_matrix)
    vertex_colours = None if colours is None else _read_colours(colours, inside.shape)
    started = time.perf_counter()
    with Messages(quiet=quiet).progress("integrating", 1.0) as advance:
        done = 0.0

        def progress(iteration: int, most: int) -> None:
            nonlocal done
            # It mostly ends long before the most iterations, and the first ones change most.
            share = 1 - 0.5 ** (8 * iteration / most)
            advance(share - done)
            done = share

        depth = integrate_normals(
            normal_map, inside, camera_matrix=matrix, stiffness=stiffness, progress=progress
        )
    mesh = surface_mesh(depth, inside, matrix, vertex_colours, largest_step=largest_step)
    low, high = (round(float(value), 4) for value in (depth[inside].min(), depth[inside].max()))
    report: dict[str, Any] = {
        "normals": str(normals),
        "camera": "orthographic" if matrix is None else "perspective",
        "n_pixels": int(inside.sum()),
        "image_size": [inside.shape[1], inside.shape[0]],
        "range": [low, high],
        "n_triangles": len(mesh.triangles),
        "stiffness": stiffness,
        "seconds": round(time.perf_counter() - started, 3),
        "files": [*(SURFACE_FILES[form] for form in wanted), SURFACE_REPORT],
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_surface(folder, depth, mesh, wanted)
    write_text(folder / SURFACE_REPORT, json.dumps(report, indent=2) + "\n")
    if as_json:
        print(json.dumps(report, indent=2))
    elif not quiet:
        unit = "pixels" if matrix is None else "of the mean depth"
        print(
            f"{folder}: {report['n_pixels']} pixels, from {low:.4g} to {high:.4g} {unit}, {report['seconds']:.1f} s"
        )


def _find_in(folder: Path) -> Path:
    from splinecli.results.files import NORMALS

    names = [NORMALS[form] for form in FORMS]
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise InputError(
        f"holds no normal map ({', '.join(names)})",
        path=folder,
        hint="Give a folder that 'splinecli infer' wrote",
    )


def _is_directx(path: Path) -> bool:
    """Whether a picture of infer's has green for y down, as the report beside it says."""
    from splinecli.results.files import REPORT

    try:
        report = json.loads((path.parent / REPORT).read_text("utf-8"))
        return path.suffix == ".png" and report["options"]["convention"] == "directx"
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _read_colours(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    import numpy as np

    from splinecli.capture import read_image

    found = read_image(path)
    _check_size("picture", found.shape, shape, path)
    colours: NDArray[np.uint8] = np.rint(
        255 * np.broadcast_to(found, (*found.shape[:2], 3)).clip(0, 1)
    ).astype(np.uint8)
    return colours


def _check_size(what: str, found: tuple[int, ...], expected: tuple[int, ...], path: Path) -> None:
    if found[:2] != expected[:2]:
        raise InputError(
            f"found a {what} of {found[1]} x {found[0]} pixels,"
            f" expected {expected[1]} x {expected[0]} as the normal map",
            path=path,
        )


def _read_matrix(path: Path) -> NDArray[np.float64]:
    from splinecli.capture.formats.text import read_number_rows

    matrix = read_number_rows(path).as_array()
    if matrix.shape != (3, 3):
        raise InputError(
            f"found {matrix.shape[0]} x {matrix.shape[1]} numbers, expected 3 x 3",
            path=path,
            hint="A camera matrix has the rows fx 0 cx, 0 fy cy and 0 0 1, in pixels",
        )
    return matrix
