"""Reads GLB files as the specification of glTF 2.0 has them, and checks what it requires."""

import io
import json
import struct

import numpy as np
from PIL import Image

from scenes import assert_unit

_TYPES = {5126: ("<f4", 4), 5125: ("<u4", 4)}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_glb(content):
    """Return the tree of a GLB file, and the arrays of its only mesh: attributes, "indices" and
    textures.
    """
    magic, version, length, json_length, json_kind = struct.unpack("<4sIIII", content[:20])
    assert magic == b"glTF"
    assert version == 2
    assert length == len(content)
    assert json_kind == 0x4E4F534A
    tree = json.loads(content[20 : 20 + json_length])
    start = 20 + json_length
    binary_length, binary_kind = struct.unpack("<II", content[start : start + 8])
    assert binary_kind == 0x004E4942
    assert json_length % 4 == 0
    assert binary_length % 4 == 0
    binary = content[start + 8 :]
    assert len(binary) == binary_length
    assert tree["asset"]["version"] == "2.0"
    [buffer] = tree["buffers"]
    assert binary_length - 3 <= buffer["byteLength"] <= binary_length

    def view(number):
        found = tree["bufferViews"][number]
        first = found.get("byteOffset", 0)
        assert 0 <= first < first + found["byteLength"] <= buffer["byteLength"]
        return first, binary[first : first + found["byteLength"]]

    def array(number):
        accessor = tree["accessors"][number]
        dtype, size = _TYPES[accessor["componentType"]]
        first, content = view(accessor["bufferView"])
        assert (first + accessor.get("byteOffset", 0)) % size == 0
        width = _WIDTHS[accessor["type"]]
        values = np.frombuffer(
            content, dtype, accessor["count"] * width, accessor.get("byteOffset", 0)
        )
        values = values.reshape(-1, width)
        for bound, found in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
            if bound in accessor:
                np.testing.assert_array_equal(np.float32(accessor[bound]), np.float32(found))
        return values

    [mesh] = tree["meshes"]
    [part] = mesh["primitives"]
    assert part.get("mode", 4) == 4
    arrays = {name: array(number) for name, number in part["attributes"].items()}
    arrays["indices"] = array(part["indices"]).reshape(-1, 3)
    assert {"min", "max"} <= set(tree["accessors"][part["attributes"]["POSITION"]])
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
            arrays[name] = np.asarray(Image.open(io.BytesIO(view(picture["bufferView"])[1])))
    return tree, arrays
