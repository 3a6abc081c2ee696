"""Estimate the normals of the medallion from Python with two methods, and compare them with the
ground truth.

python examples/python_api.py [FOLDER]        # default: out/python_api, for the pictures of the
normal maps
"""

import sys
from pathlib import Path

import cv2

from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.maths.normals import encode_picture
from splinecli.recipe import read_capture

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/python_api")
folder.mkdir(parents=True, exist_ok=True)

# The capture holds the observations of the pixels in the mask, divided by the light intensities.
capture = read_capture(Path(__file__).parent / "medallion")
print(f"{capture.name}: {capture.n_pixels} pixels, {capture.n_lights} lights")

for method in ("ls", "spline-net"):
    # normal_map: (H, W, 3) float32; x right, y up, z to the camera; zero outside the mask.
    estimate = estimate_normals(capture, make_estimator(method))
    # A capture without ground truth has no errors.
    if estimate.errors is not None:
        print(
            f"{method}: MAE {estimate.errors.mean:.2f} deg, median {estimate.errors.median:.2f} deg"
        )
    picture = encode_picture(estimate.normal_map, capture.mask)  # 16-bit RGB; OpenCV writes BGR
    cv2.imwrite(str(folder / f"{method}.png"), picture[..., ::-1])
