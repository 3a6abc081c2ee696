"""Pixels a second of every method, as shipped, on one capture under ten of its lights.

    python benchmarks/method_speed.py CAPTURE [PIXELS]

Each method first runs once on a part of the pixels, then three times; printed is the fastest. PIXELS (20000) are taken
from the capture in order; the networks take a tenth of them.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from splinecli.capture import open_capture
from splinecli.capture.lights.draws import draw_lights
from splinecli.methods import make_estimator, method_names

N_LIGHTS = 10
REPEATS = 3
NETWORKS = ("spline-net", "cnn-ps")


def main(folder: str, pixels: int) -> None:
    source = open_capture(folder)
    (lights,) = draw_lights(source.light_directions, N_LIGHTS, seed=0)
    capture = source.read(lights, as_stored=True)
    print(f"{capture.name}, {N_LIGHTS} lights")
    for name in method_names():
        count = pixels // 10 if name in NETWORKS else pixels
        observations = np.resize(capture.observations, (count, N_LIGHTS))
        estimator = make_estimator(name)
        estimator.estimate(observations[: count // 4], capture.light_directions)
        seconds = []
        for _ in range(REPEATS):
            started = time.perf_counter()
            estimator.estimate(observations, capture.light_directions)
            seconds.append(time.perf_counter() - started)
        precision = f"{estimator.device}, {estimator.precision}"
        print(f"{name:12} {count / min(seconds):12,.0f} pixels/s  ({precision})")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) == 3 else 20_000)
