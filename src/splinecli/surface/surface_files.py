"""The files of a surface: meshes, and the depth map as float32 NPY and TIFF."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splinecli.files import write_bytes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splinecli.surface.mesh import SurfaceMesh

SURFACE_FILES = {"ply": "mesh.ply", "obj": "mesh.obj", "npy": "depth.npy", "tiff": "depth.tiff"}
"""The file name of each format."""

SURFACE_REPORT = "surface.json"
"""The report that `integrate` writes beside them."""

DEFAULT_FORMATS = ("ply", "npy", "tiff")


def write_surface(
    folder: Path, depth: NDArray[np.floating], mesh: SurfaceMesh, formats: Sequence[str] = DEFAULT_FORMATS
) -> None:
    """Write a surface to the files that SURFACE_FILES names, each complete or not at all.

    Args:
        folder: the folder of the files; it is made where it does not exist.
        depth: (H, W), NaN outside the object.
        mesh: the mesh of the same surface.
        formats: keys of SURFACE_FILES.

    Raises:
        OutputError: a file cannot be written.
    """
    import numpy as np

    from splinecli.surface.mesh import write_mesh

    depth = depth.astype(np.float32)
    for name in formats:
        path = folder / SURFACE_FILES[name]
        if name in ("ply", "obj"):
            write_mesh(mesh, path)
            continue
        buffer = io.BytesIO()
        if name == "npy":
            np.save(buffer, depth, allow_pickle=False)
        else:
            import tifffile

            tifffile.imwrite(buffer, depth)
        write_bytes(path, buffer.getvalue())
