"""Hand normal maps of several views to multi-view tools, in the layout of AliceVision's node
PhotometricStereo.

    python examples/normal_maps_for_meshroom.py CAMERAS.sfm OUT RESULTS [RESULTS ...]

CAMERAS.sfm (or .json) is the SfMData file of StructureFromMotion, with views, intrinsics and poses.
Each RESULTS is a folder that `splinecli infer` wrote, with normals.npy. It belongs to the view
whose photograph is in the folder of the capture, or has its name: capture `cat03` to
`.../cat03/0001.png` or `.../cat03.png`.

For each view, OUT gets POSE_normals.exr in the camera's frame (x right, y down, z away from the
camera), and POSE_normals_w.exr in the world's, both as float values, and POSE_mask.png.
OUT/normalMaps.sfm has these views with their cameras. The images must be undistorted, and whole: no
--crop or --scale.
"""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splinecli.surface.surface_files import encode_exr

Y_DOWN_Z_AWAY = np.array(
    (1, -1, -1), np.float32
)  # from splinecli's frame to the camera's frame of SfMData


def view_of(capture: str, cameras: dict[str, Any]) -> dict[str, Any]:
    """Return the view of a capture: of several with one pose, the one that has the name of the
    pose.
    """
    views = [
        view
        for view in cameras["views"]
        if capture in (Path(view["path"]).stem, Path(view["path"]).parent.name)
    ]
    named = [view for view in views if view["viewId"] == view["poseId"]]
    if not views:
        raise SystemExit(f"found no view of {capture} among the {len(cameras['views'])} views")
    return dict((named or views)[0])


def rotation_of(pose_id: str, cameras: dict[str, Any]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from the world to the camera. SfMData stores it column by column,
    as text.
    """
    for pose in cameras["poses"]:
        if pose["poseId"] == pose_id:
            return np.array(pose["pose"]["transform"]["rotation"], np.float64).reshape(3, 3).T
    raise SystemExit(f"the pose {pose_id} is not in the file: its view was not reconstructed")


def main(cameras_file: Path, out: Path, results: list[Path]) -> None:
    cameras = json.loads(cameras_file.read_text("utf-8"))
    out.mkdir(parents=True, exist_ok=True)
    views = []
    for folder in results:
        normals = np.load(folder / "normals.npy")
        mask = normals.any(axis=2)
        view = view_of(folder.name, cameras)
        if mask.shape != (int(view["height"]), int(view["width"])):
            raise SystemExit(
                f"{folder} has {mask.shape[::-1]} pixels, its view {view['width']} x"
                f" {view['height']}"
            )
        rotation = rotation_of(view["poseId"], cameras)
        in_camera = normals * Y_DOWN_Z_AWAY
        in_world = (in_camera @ rotation).astype(np.float32)  # rows: rotation' n
        for name, values in (("normals", in_camera), ("normals_w", in_world)):
            (out / f"{view['poseId']}_{name}.exr").write_bytes(
                encode_exr(values, {"normals": "as they are, not coloured"})
            )
        cv2.imwrite(str(out / f"{view['poseId']}_mask.png"), mask.astype(np.uint8) * 255)
        views.append({**view, "path": str((out / f"{view['poseId']}_normals_w.exr").absolute())})
    kept = {key: cameras[key] for key in ("version", "intrinsics", "poses") if key in cameras}
    (out / "normalMaps.sfm").write_text(json.dumps({**kept, "views": views}, indent=4), "utf-8")
    print(f"{out}: {len(views)} views")


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), [Path(name) for name in sys.argv[3:]])
