"""The files of a mesh: glTF (GLB), PLY, OBJ and STL."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from splinecli.surface.mesh import SurfaceMesh, no_triangles

GRAY = 204
"""Colour of a mesh without a texture, of 255."""

_FLOAT = 5126  # of glTF


def encode_glb(mesh: SurfaceMesh, *, metres: float) -> bytes:
    """Return a mesh as binary glTF 2.0: a matte material with the textures, lit from both sides.

    Args:
        mesh: what surface_mesh or decimate returned, with at least one triangle.
        metres: the length of one unit of the mesh. A file of glTF has metres.

    Raises:
        InputError: the mesh has no triangles.
    """
    import trimesh

    if not len(mesh.triangles):
        raise no_triangles()
    textures = {"baseColorTexture": mesh.texture, "normalTexture": mesh.normal_texture}
    material = trimesh.visual.material.PBRMaterial(
        name="surface",
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
        baseColorFactor=[GRAY] * 3 + [255] if mesh.texture is None else None,
        **{name: _image(picture) for name, picture in textures.items() if picture is not None},
    )
    shown = _trimesh(mesh, _textured(mesh, material), metres)
    glb: bytes = trimesh.exchange.gltf.export_glb(
        shown.scene(), include_normals=True, buffer_postprocessor=_tangent_writer(mesh)
    )
    return glb


def encode_ply(mesh: SurfaceMesh, *, unit: str) -> bytes:
    """Return a mesh as binary PLY, with the normals and colours of the vertices. A comment has the unit's name."""
    import trimesh

    colours = None if mesh.colours is None else trimesh.visual.ColorVisuals(vertex_colors=mesh.colours)
    ply: bytes = trimesh.exchange.ply.export_ply(_trimesh(mesh, colours), vertex_normal=True)
    return ply.replace(b" 1.0\n", f" 1.0\ncomment unit: {unit}\n".encode(), 1)


def encode_stl(mesh: SurfaceMesh) -> bytes:
    """Return a mesh as binary STL, which has positions alone."""
    import trimesh

    stl: bytes = trimesh.exchange.stl.export_stl(_trimesh(mesh))
    return stl


def encode_obj(mesh: SurfaceMesh, *, name: str, unit: str) -> dict[str, bytes]:
    """Return a mesh as OBJ with normals and texture coordinates. A comment has the name of the unit.

    The files are NAME.obj, NAME.mtl and, with colours, NAME.png.
    """
    import trimesh

    image = None if mesh.texture is None else _image(mesh.texture)
    diffuse = (GRAY if image is None else 255,) * 3
    material = trimesh.visual.material.SimpleMaterial(image, diffuse, specular=(0, 0, 0), name=name)
    text, files = trimesh.exchange.obj.export_obj(
        _trimesh(mesh, _textured(mesh, material)),
        include_normals=True,
        return_texture=True,
        mtl_name=f"{name}.mtl",
        header=f"unit: {unit}",
    )
    return {f"{name}.obj": text.encode(), **files}


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


def _image(picture: np.ndarray) -> Any:
    from PIL import Image

    return Image.fromarray(picture)


def _tangent_writer(mesh: SurfaceMesh) -> Callable[[Any, Any], None] | None:
    """Return the function that adds the tangents to the buffers and the tree of a glTF file, or None without any.

    Without them, viewers derive their own tangents in different ways.
    """
    tangents = mesh.tangents
    if tangents is None:
        return None

    def add(buffers: Any, tree: Any) -> None:
        for part in (part for shape in tree["meshes"] for part in shape["primitives"]):
            part["attributes"]["TANGENT"] = len(tree["accessors"])
        tree["accessors"]["tangents"] = {
            "bufferView": len(buffers),
            "componentType": _FLOAT,
            "type": "VEC4",
            "count": len(tangents),
        }
        # The last number is the sign of the bitangent.
        buffers["tangents"] = np.insert(tangents, 3, 1, axis=1).astype("<f4").tobytes()

    return add
