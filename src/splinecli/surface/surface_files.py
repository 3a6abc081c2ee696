"""The files of a surface: meshes (glTF, PLY, OBJ, STL, 3MF) and depth maps (NPY, TIFF, EXR, PNG).

The command line needs the names in this file, so every import heavier than NumPy is inside a
function.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from splinecli.errors import OutputError
from splinecli.maths import Float32Array, Floats, Integers, Picture
from splinecli.maths.transfer import decode_transfer, encode_srgb
from splinecli.records.output_files import SURFACE_FILES
from splinecli.system.machine import import_extra

if TYPE_CHECKING:
    from splinecli.surface.mesh import SurfaceMesh
    from splinecli.system.publishing import Content


DEFAULT_FORMATS = ("glb", "ply", "npy", "tiff", "png")
USUAL_SPECULAR = 0.5  # glTF's default, a reflectance of 4 %
GRAY = 204  # colour of a mesh without a texture, from 0 to 255


@dataclass(frozen=True)
class Surface:
    """A depth map and its mesh."""

    depth: Floats  # (H, W), NaN outside the object
    mesh: SurfaceMesh  # the mesh of the same surface
    unit: str  # the name of their unit
    millimetres: float  # the length of this unit in glTF and 3MF files
    # (H, W, 3), the normals of a levelled surface
    level_normals: Float32Array | None = None


def encode_surface(
    surface: Surface, formats: Sequence[str] = DEFAULT_FORMATS
) -> Iterator[tuple[str, Content]]:
    """Yield the name and the content (see NewFiles.write) of each file of a surface.

    The formats are keys of SURFACE_FILES. Raises InputError if a mesh without triangles would be
    written as GLB.
    """
    for form in formats:
        if form == "obj":
            yield from _encode_obj(surface).items()
        else:
            yield SURFACE_FILES[form][0], _ENCODERS[form](surface)


def _encode_glb(surface: Surface) -> bytes:
    """Return binary glTF 2.0 in metres, with two-sided textures. Without a gloss, the surface is
    matte.
    """
    import trimesh
    from PIL import Image

    from splinecli.surface.mesh import no_triangles, with_smooth_outline

    mesh = surface.mesh
    if not len(mesh.triangles):
        raise no_triangles()
    if mesh.normal_texture is None:  # the outline of a decimated mesh is already smooth
        mesh = with_smooth_outline(mesh)

    def add_rest(buffers: Any, tree: Any) -> None:
        """Add the parts of a glTF file that trimesh cannot write.

        Tangents are included because viewers would compute them in different ways.
        """
        if mesh.specular is not None:
            _add_specular(buffers, tree, mesh.specular)
        if mesh.tangents is None:
            return
        for part in (part for shape in tree["meshes"] for part in shape["primitives"]):
            part["attributes"]["TANGENT"] = len(tree["accessors"])
        accessor = {
            "bufferView": len(buffers),
            "componentType": 5126,
            "type": "VEC4",
            "count": len(mesh.tangents),
        }
        tree["accessors"]["tangents"] = accessor
        # The last number is the sign of the bitangent.
        buffers["tangents"] = np.insert(mesh.tangents, 3, 1, axis=1).astype("<f4").tobytes()

    textures = {
        "baseColorTexture": mesh.texture,
        "normalTexture": mesh.normal_texture,
        "metallicRoughnessTexture": mesh.gloss,
    }
    material = trimesh.visual.material.PBRMaterial(
        name="surface",
        metallicFactor=0.0 if mesh.gloss is None else 1.0,
        roughnessFactor=1.0,
        doubleSided=True,
        baseColorFactor=[GRAY] * 3 + [255] if mesh.texture is None else None,
        **{
            name: Image.fromarray(picture)
            for name, picture in textures.items()
            if picture is not None
        },
    )
    shown = _trimesh(mesh, _textured(mesh, material), surface.millimetres / 1000)
    glb: bytes = trimesh.exchange.gltf.export_glb(
        shown.scene(), include_normals=True, buffer_postprocessor=add_rest
    )
    return glb


def _add_specular(buffers: Any, tree: Any, specular: Float32Array) -> None:
    """Add KHR_materials_specular, the reflectance (H, W) relative to the default.

    The glTF file has one material.
    """
    relative = specular / USUAL_SPECULAR
    largest = float(relative.max())
    if np.abs(relative - 1).max() < 0.01:
        return
    added: dict[str, Any] = {"specularColorFactor": [largest] * 3}
    if np.ptp(relative) > 0.01 * largest:
        added["specularColorTexture"] = {"index": len(tree["textures"])}
        tree["textures"].append({"source": len(tree["images"])})
        tree["images"].append({"bufferView": len(buffers), "mimeType": "image/png"})
        png = _encode_texture(np.repeat(encode_srgb(relative / largest)[..., None], 3, axis=2))
        buffers["specular"] = png + bytes(-len(png) % 4)
    tree["materials"][0]["extensions"] = {"KHR_materials_specular": added}
    tree["extensionsUsed"] = ["KHR_materials_specular"]


def _encode_texture(picture: Picture) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def _encode_ply(surface: Surface) -> bytes:
    """Return binary PLY with the normals and colours of the vertices, and the unit in a comment."""
    import trimesh

    mesh = surface.mesh
    colours = (
        None if mesh.colours is None else trimesh.visual.ColorVisuals(vertex_colors=mesh.colours)
    )
    ply: bytes = trimesh.exchange.ply.export_ply(_trimesh(mesh, colours), vertex_normal=True)
    return ply.replace(b" 1.0\n", f" 1.0\ncomment unit: {surface.unit}\n".encode(), 1)


def _encode_obj(surface: Surface) -> dict[str, bytes]:
    """Return OBJ files with normals, texture coordinates and, with colours, textures.

    A comment contains the unit. With a gloss, the material has the maps of the extension for
    physically-based rendering. For programs that do not read these maps, it also has a Phong
    highlight of the same height and about the same width.
    """
    import trimesh
    from PIL import Image

    mesh = surface.mesh
    image = None if mesh.texture is None else Image.fromarray(mesh.texture)
    diffuse = (GRAY if image is None else 255,) * 3
    reflectance, shininess = 0.0, 1.0
    if mesh.gloss is not None and mesh.texture is not None:
        roughness, metalness = np.moveaxis(mesh.gloss[..., 1:] / 255, 2, 0)
        specular = USUAL_SPECULAR if mesh.specular is None else mesh.specular
        base = decode_transfer(mesh.texture.mean(axis=2) / 255, None)
        square = max(float(roughness.mean()) ** 4, 1e-3)  # squared width of the facets' slopes
        reflectance = float((0.08 * specular * (1 - metalness) + base * metalness).mean()) / (
            4 * square
        )
        shininess = 2 / square - 2
    gray = (round(255 * min(reflectance, 1.0)),) * 3
    material = trimesh.visual.material.SimpleMaterial(
        image, diffuse, specular=gray, glossiness=shininess, name="mesh"
    )
    text, files = trimesh.exchange.obj.export_obj(
        _trimesh(mesh, _textured(mesh, material)),
        include_normals=True,
        return_texture=True,
        mtl_name="mesh.mtl",
        header=f"unit: {surface.unit}",
    )
    if mesh.gloss is not None:
        for place, (name, key) in enumerate(
            (("mesh_roughness.png", "map_Pr"), ("mesh_metalness.png", "map_Pm")), 1
        ):
            files["mesh.mtl"] += f"\n{key} {name}".encode()
            files[name] = _encode_texture(mesh.gloss[..., place])
    return {"mesh.obj": text.encode(), **files}


_XML = '<?xml version="1.0" encoding="UTF-8"?>\n'
_PACKAGE = {
    "[Content_Types].xml": """<Types
xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>""",
    "_rels/.rels": """<Relationships
xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Id="model" Target="/3D/3dmodel.model"
Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>""",
    "3D/3dmodel.model": """<model unit="millimeter" xml:lang="en"
xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
<resources><object id="1" type="model"><mesh>
<vertices>
{vertices}</vertices>
<triangles>
{triangles}</triangles>
</mesh></object></resources>
<build><item objectid="1"/></build>
</model>""",
}


def _encode_3mf(surface: Surface) -> bytes:
    """Return 3MF (3D Manufacturing Format, core specification 1.3) in millimetres."""
    lines = {
        "vertices": _lines(
            '<vertex x="%.7g" y="%.7g" z="%.7g"/>\n', surface.mesh.vertices * surface.millimetres
        ),
        "triangles": _lines('<triangle v1="%d" v2="%d" v3="%d"/>\n', surface.mesh.triangles),
    }
    file = io.BytesIO()
    with ZipFile(file, "w") as package:
        for name, text in _PACKAGE.items():
            package.writestr(ZipInfo(name), _XML + text.format(**lines), ZIP_DEFLATED)
    return file.getvalue()


def _lines(line: str, rows: Floats | Integers) -> str:
    """Return the text of all rows (N, 3), converting few numbers to objects at a time."""
    parts = np.array_split(rows, len(rows) // 100_000 + 1)
    return "".join(line * len(part) % tuple(part.ravel().tolist()) for part in parts)


def encode_tiff(values: Float32Array, description: str) -> bytes:
    """Return the TIFF file of a map (H, W) or (H, W, C)."""
    import tifffile

    file = io.BytesIO()
    layout = "contig" if values.ndim == 3 else None
    tifffile.imwrite(
        file, values, photometric="minisblack", planarconfig=layout, description=description
    )
    return file.getvalue()


def _encode_exr(surface: Surface) -> bytes:
    low = np.nanmin(surface.depth)
    heights = np.where(np.isfinite(surface.depth), surface.depth, low).astype(np.float32)
    return encode_exr(heights, {"unit": surface.unit, "outside": f"{low:.7g}"})


def _encode_png(surface: Surface) -> bytes:
    """Return the depth map as 16-bit gray: 0 outside the object, then 1 to 65535 by depth.

    The text `depth` in the PNG file contains these values and their unit.
    """
    from PIL import Image, PngImagePlugin

    low, high = float(np.nanmin(surface.depth)), float(np.nanmax(surface.depth))
    share = (surface.depth - low) / max(high - low, np.finfo(np.float64).tiny)
    file, text = io.BytesIO(), PngImagePlugin.PngInfo()
    text.add_text("depth", f"0 outside, 1 = {low:.7g}, 65535 = {high:.7g}; unit: {surface.unit}")
    gray = np.where(np.isfinite(share), np.rint(1 + np.nan_to_num(share) * 65534), 0)
    Image.fromarray(gray.astype(np.uint16)).save(file, "PNG", pnginfo=text)
    return file.getvalue()


_ENCODERS: dict[str, Callable[[Surface], Content]] = {
    "glb": _encode_glb,
    "ply": _encode_ply,
    # binary, with positions only
    "stl": lambda surface: _trimesh(surface.mesh).export(file_type="stl"),
    "3mf": _encode_3mf,
    "npy": lambda surface: surface.depth.astype("f4"),
    "tiff": lambda surface: encode_tiff(surface.depth.astype("f4"), f"unit: {surface.unit}"),
    "png": _encode_png,
    "exr": _encode_exr,
}


def _trimesh(mesh: SurfaceMesh, visual: Any = None, scale: float = 1) -> Any:
    import trimesh

    return trimesh.Trimesh(
        mesh.vertices * np.float32(scale),
        mesh.triangles,
        vertex_normals=mesh.normals,
        visual=visual,
        process=False,
    )


def _textured(mesh: SurfaceMesh, material: Any) -> Any:
    import trimesh

    # v runs up in trimesh and OBJ.
    return trimesh.visual.TextureVisuals(mesh.uvs * (1, -1) + (0, 1), material)


def encode_exr(pixels: Floats, attributes: Mapping[str, str]) -> bytes:
    """Return an EXR file of a float16 or float32 map, with texts by name in its header.

    Compression (ZIP) is lossless. A map (H, W, 3) has the channels R, G and B, and a map (H, W) the
    channel Y, because Blender reads these names. Raises UsageError if OpenEXR is not installed, or
    OutputError if the folder for temporary files cannot be written.
    """
    library = import_extra("OpenEXR", "exr")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage, **attributes}
    channels = {"Y" if pixels.ndim == 2 else "RGB": np.ascontiguousarray(pixels)}
    # The library can only write files.
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.exr"
        try:
            library.File(header, channels).write(str(path))
            return path.read_bytes()
        except (OSError, RuntimeError) as error:
            raise OutputError(f"cannot be written ({error})", path=path) from error


def check_exr(formats: Sequence[str]) -> None:
    """Raise UsageError if EXR files are requested and the library is not installed."""
    if "exr" in formats:
        import_extra("OpenEXR", "exr")
