"""The files of a surface: meshes, and its depth as float32 NPY and TIFF."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.files import write_bytes
from splinecli.surface.mesh import SurfaceMesh, write_mesh

SURFACE_FILES = {"ply": "mesh.ply", "obj": "mesh.obj", "npy": "depth.npy", "tiff": "depth.tiff"}
"""By the names of their forms."""

SURFACE_REPORT = "surface.json"
"""Beside them, where `integrate` wrote them."""

USUAL_FORMS = ("ply", "npy", "tiff")


def write_surface(
    folder: Path, depth: NDArray[np.floating], mesh: SurfaceMesh, forms: Sequence[str] = USUAL_FORMS
) -> None:
    """Write some of SURFACE_FILES, each whole or not at all; depth (H, W) is NaN outside. Raises OutputError."""
    depth = depth.astype(np.float32)
    for form in forms:
        path = folder / SURFACE_FILES[form]
        if form in ("ply", "obj"):
            write_mesh(mesh, path)
            continue
        buffer = io.BytesIO()
        if form == "npy":
            np.save(buffer, depth, allow_pickle=False)
        else:
            import tifffile

            tifffile.imwrite(buffer, depth)
        write_bytes(path, buffer.getvalue())
