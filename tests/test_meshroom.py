"""The example that hands normal maps to Meshroom, against the layout of SfMData and a view that is
known.
"""

import json
import runpy
from pathlib import Path

import cv2
import numpy as np
import pytest

from scenes import read_json

EXAMPLE = Path(__file__).parents[1] / "examples/normal_maps_for_meshroom.py"
# A camera along the world's x axis: its x is the world's -y, its y (down) the world's -z, and its z
# the world's x.
ROTATION = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], float)
CAMERAS = {
    "version": ["1", "2", "7"],
    "views": [
        {
            "viewId": str(view),
            "poseId": "12",
            "frameId": "0",
            "intrinsicId": "7",
            "path": f"/photos/ps_cat/{view}.png",
            "width": "4",
            "height": "3",
        }
        for view in (11, 12)
    ],
    "intrinsics": [
        {
            "intrinsicId": "7",
            "width": "4",
            "height": "3",
            "sensorWidth": "36",
            "sensorHeight": "27",
            "type": "pinhole",
            "focalLength": "50",
            "principalPoint": ["0", "0"],
        }
    ],
    "poses": [
        {
            "poseId": "12",
            "pose": {
                "transform": {
                    "rotation": [f"{value:g}" for value in ROTATION.T.ravel()],
                    "center": ["0", "0", "0"],
                },
                "locked": "0",
            },
        }
    ],
}


def test_normals_reach_the_world(tmp_path, capsys):
    exr = pytest.importorskip("OpenEXR")
    normals = np.zeros((3, 4, 3), np.float32)
    # one towards the camera, one also to its right
    normals[1, 1], normals[1, 2] = ((0, 0, 1), (0.6, 0.0, 0.8))
    (tmp_path / "ps_cat").mkdir()
    np.save(tmp_path / "ps_cat/normals.npy", normals)
    (tmp_path / "cameras.sfm").write_text(json.dumps(CAMERAS))
    main = runpy.run_path(str(EXAMPLE))["main"]
    main(tmp_path / "cameras.sfm", tmp_path / "maps", [tmp_path / "ps_cat"])
    written = read_json(tmp_path / "maps/normalMaps.sfm")
    assert written["views"] == [
        {**CAMERAS["views"][1], "path": str(tmp_path / "maps/12_normals_w.exr")}  # type: ignore[index]
    ]
    assert (written["poses"], written["intrinsics"]) == (CAMERAS["poses"], CAMERAS["intrinsics"])

    def read(name):
        pixels = exr.File(str(tmp_path / "maps" / name)).channels()["RGB"].pixels
        return np.asarray(pixels)[1, 1:3]

    assert read("12_normals.exr") == pytest.approx(np.array([[0, 0, -1], [0.6, 0, -0.8]]))
    assert read("12_normals_w.exr") == pytest.approx(np.array([[-1, 0, 0], [-0.8, -0.6, 0]]))
    assert cv2.imread(str(tmp_path / "maps/12_mask.png"), cv2.IMREAD_GRAYSCALE)[1].tolist() == [
        0,
        255,
        255,
        0,
    ]
    (tmp_path / "dog").mkdir()
    np.save(tmp_path / "dog/normals.npy", normals)
    with pytest.raises(SystemExit, match="no view of dog"):
        main(tmp_path / "cameras.sfm", tmp_path / "maps", [tmp_path / "dog"])
