"""The example that hands normal maps to Meshroom, against the layout of SfMData and a view that is
known.
"""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from scenes import put, read_image, read_json

EXAMPLE = Path(__file__).parents[1] / "examples/normal_maps_for_meshroom.py"
# A camera along the world's x axis: its x is the world's -y, its y (down) the world's -z, and its z
# the world's x.
CAMERAS = json.loads("""{
"version": ["1", "2", "7"],
"views": [
    {"viewId": "11", "poseId": "12", "frameId": "0", "intrinsicId": "7",
     "path": "/photos/ps_cat/11.png", "width": "4", "height": "3"},
    {"viewId": "12", "poseId": "12", "frameId": "0", "intrinsicId": "7",
     "path": "/photos/ps_cat/12.png", "width": "4", "height": "3"}],
"intrinsics": [
    {"intrinsicId": "7", "width": "4", "height": "3", "sensorWidth": "36", "sensorHeight": "27",
     "type": "pinhole", "focalLength": "50", "principalPoint": ["0", "0"]}],
"poses": [
    {"poseId": "12", "pose": {"locked": "0", "transform": {
        "rotation": ["0", "0", "1", "-1", "0", "0", "0", "-1", "0"],
        "center": ["0", "0", "0"]}}}]
}""")


def test_normals_reach_the_world(tmp_path, capsys):
    exr = pytest.importorskip("OpenEXR")
    normals = np.zeros((3, 4, 3), np.float32)
    # one towards the camera, one also to its right
    normals[1, 1], normals[1, 2] = ((0, 0, 1), (0.6, 0.0, 0.8))
    (tmp_path / "ps_cat").mkdir()
    np.save(tmp_path / "ps_cat/normals.npy", normals)
    put(tmp_path / "cameras.sfm", json.dumps(CAMERAS))
    main = runpy.run_path(str(EXAMPLE))["main"]
    main(tmp_path / "cameras.sfm", tmp_path / "maps", [tmp_path / "ps_cat"])
    written = read_json(tmp_path / "maps/normalMaps.sfm")
    assert written["views"] == [
        {**CAMERAS["views"][1], "path": str(tmp_path / "maps/12_normals_w.exr")}
    ]
    assert written["poses"] == CAMERAS["poses"]
    assert written["intrinsics"] == CAMERAS["intrinsics"]

    def read(name):
        pixels = exr.File(str(tmp_path / "maps" / name)).channels()["RGB"].pixels
        return np.asarray(pixels)[1, 1:3]

    assert read("12_normals.exr") == pytest.approx(np.array([[0, 0, -1], [0.6, 0, -0.8]]))
    assert read("12_normals_w.exr") == pytest.approx(np.array([[-1, 0, 0], [-0.8, -0.6, 0]]))
    assert read_image(tmp_path / "maps/12_mask.png")[1].tolist() == [0, 255, 255, 0]
    (tmp_path / "dog").mkdir()
    np.save(tmp_path / "dog/normals.npy", normals)
    with pytest.raises(SystemExit, match="no view of dog"):
        main(tmp_path / "cameras.sfm", tmp_path / "maps", [tmp_path / "dog"])
