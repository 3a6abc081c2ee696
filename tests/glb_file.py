"""Reads GLB files, and checks what trimesh does not guarantee."""

import io
import json
import struct

import numpy as np
from PIL import Image

from scenes import assert_unit

_TYPES = {5126: "<f4", 5125: "<u4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_glb(content):
    """Return the tree of a GLB file, and the arrays of its only mesh: attributes, "indices" and
    textures.
    """
    length = struct.unpack_from("<I", content, 12)[0]
    tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]

    def view(number):
        found = tree["bufferViews"][number]
        first = found.get("byteOffset", 0)
        return binary[first : first + found["byteLength"]]

    def array(number):
        accessor = tree["accessors"][number]
        dtype = _TYPES[accessor["componentType"]]
        width, place = _WIDTHS[accessor["type"]], accessor.get("byteOffset", 0)
        count, own = accessor["count"] * width, accessor["bufferView"]
        assert (tree["bufferViews"][own].get("byteOffset", 0) + place) % 4 == 0
        return np.frombuffer(view(own), dtype, count, place).reshape(-1, width)

    [mesh] = tree["meshes"]
    [part] = mesh["primitives"]
    assert part.get("mode", 4) == 4
    arrays = {name: array(number) for name, number in part["attributes"].items()}
    arrays["indices"] = array(part["indices"]).reshape(-1, 3)
    assert {len(values) for name, values in arrays.items() if name != "indices"} == {
        len(arrays["POSITION"])
    }
    assert arrays["indices"].max() < len(arrays["POSITION"])
    for name in {"NORMAL", "TANGENT"} & set(arrays):
        assert_unit(arrays[name][:, :3])
    material = tree["materials"][part["material"]]
    extension = material.get("extensions", {}).get("KHR_materials_specular", {})
    assert set(material.get("extensions", {})) == set(tree.get("extensionsUsed", []))
    textures = {
        "specular": extension.get("specularColorTexture"),
        "colour": material["pbrMetallicRoughness"].get("baseColorTexture"),
        "normal": material.get("normalTexture"),
        "gloss": material["pbrMetallicRoughness"].get("metallicRoughnessTexture"),
    }
    for name, reference in textures.items():
        if reference is not None:
            picture = tree["images"][tree["textures"][reference["index"]]["source"]]
            assert picture["mimeType"] == "image/png"
            arrays[name] = np.asarray(Image.open(io.BytesIO(view(picture["bufferView"]))))
    return tree, arrays
