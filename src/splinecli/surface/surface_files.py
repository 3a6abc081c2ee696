"""The files of a surface: meshes, the depth map as float32 NPY, TIFF and EXR, and as a 16-bit PNG picture."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splinecli.surface.mesh import SurfaceMesh

SURFACE_FILES = {
    "glb": ("mesh.glb",),
    "ply": ("mesh.ply",),
    "obj": ("mesh.obj", "mesh.mtl", "mesh.png"),
    "stl": ("mesh.stl",),
    "npy": ("depth.npy",),
    "tiff": ("depth.tiff",),
    "png": ("depth.png",),
    "exr": ("depth.exr",),
}
"""The file names of each format; mesh.png is the texture of an OBJ file, if there are colours."""

SURFACE_REPORT = "surface.json"
"""The report that `integrate` writes beside them."""

DEFAULT_MESHES = ("glb", "ply")
DEPTH_FORMATS = ("npy", "tiff", "png")
DEFAULT_FORMATS = (*DEFAULT_MESHES, *DEPTH_FORMATS)

_WHITE = 65535  # of 16 bits


@dataclass(frozen=True)
class Surface:
    """A depth map and its mesh.

    Args:
        depth: (H, W), NaN outside the object.
        mesh: the mesh of the same surface.
        unit: the name of the unit of both.
        millimetres: the length of this unit in a file of glTF.
    """

    depth: NDArray[np.floating]
    mesh: SurfaceMesh
    unit: str
    millimetres: float


def file_names(formats: Sequence[str]) -> tuple[str, ...]:
    """Return the names of all files that encode_surface may yield."""
    return tuple(name for form in formats for name in SURFACE_FILES[form])


def encode_surface(surface: Surface, formats: Sequence[str] = DEFAULT_FORMATS) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the content of each file of a surface.

    Args:
        surface: the surface.
        formats: keys of SURFACE_FILES.

    Raises:
        InputError: a mesh without triangles cannot be written as GLB.
    """
    for form in formats:
        yield from _encode(surface, form).items()


def _encode(surface: Surface, form: str) -> dict[str, bytes]:
    import numpy as np

    from splinecli.surface import mesh_files

    if form == "obj":
        return mesh_files.encode_obj(surface.mesh, name="mesh", unit=surface.unit)
    buffer = io.BytesIO()
    if form == "glb":
        buffer.write(mesh_files.encode_glb(surface.mesh, metres=surface.millimetres / 1000))
    elif form == "ply":
        buffer.write(mesh_files.encode_ply(surface.mesh, unit=surface.unit))
    elif form == "stl":
        buffer.write(mesh_files.encode_stl(surface.mesh))
    elif form == "png":
        _save_depth_picture(surface, buffer)
    elif form == "npy":
        np.save(buffer, surface.depth.astype(np.float32), allow_pickle=False)
    elif form == "exr":
        from splinecli.system.exr import encode_exr

        low = np.nanmin(surface.depth)
        heights = np.where(np.isfinite(surface.depth), surface.depth, low).astype(np.float32)
        buffer.write(encode_exr(heights, {"unit": surface.unit, "outside": f"{low:.7g}"}))
    else:
        import tifffile

        tifffile.imwrite(buffer, surface.depth.astype(np.float32), description=f"unit: {surface.unit}")
    return {SURFACE_FILES[form][0]: buffer.getvalue()}


def _save_depth_picture(surface: Surface, file: io.BytesIO) -> None:
    """Write the depth map as 16-bit gray: 0 outside the object, from 1 for the smallest value to 65535 for the largest.

    The text `depth` of the PNG file has these values and their unit.
    """
    import numpy as np
    from PIL import Image, PngImagePlugin

    low, high = float(np.nanmin(surface.depth)), float(np.nanmax(surface.depth))
    share = (surface.depth - low) / max(high - low, np.finfo(np.float64).tiny)
    text = PngImagePlugin.PngInfo()
    text.add_text("depth", f"0 outside, 1 = {low:.7g}, {_WHITE} = {high:.7g}; unit: {surface.unit}")
    gray = np.where(np.isfinite(share), np.rint(1 + np.nan_to_num(share) * (_WHITE - 1)), 0)
    Image.fromarray(gray.astype(np.uint16)).save(file, "PNG", pnginfo=text)
