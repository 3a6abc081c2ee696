"""Measure the pixels per second of every method, as shipped, on one capture under ten of its lights.

python benchmarks/method_speed.py CAPTURE [--pixels 20000] [--repeats 3]

Each method runs once on a quarter of the pixels as a warm-up and then --repeats times; the fastest run is printed. The
pixels are the first ones of the capture. The networks get a tenth of them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np

from splinecli.capture import open_capture
from splinecli.capture.lights.draws import draw_lights
from splinecli.methods import make_estimator, method_names

N_LIGHTS = 10
NETWORKS = ("spline-net", "cnn-ps")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture")
    parser.add_argument("--pixels", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    source = open_capture(options.capture)
    (lights,) = draw_lights(source.light_directions, N_LIGHTS, seed=0)
    capture = source.read(lights, as_stored=True)
    print(f"{capture.name}, {N_LIGHTS} lights")
    for name in method_names():
        count = options.pixels // 10 if name in NETWORKS else options.pixels
        observations = np.resize(capture.observations, (count, N_LIGHTS))
        estimator = make_estimator(name)
        estimator.estimate(observations[: count // 4], capture.light_directions)
        seconds = []
        for _ in range(options.repeats):
            started = time.perf_counter()
            estimator.estimate(observations, capture.light_directions)
            seconds.append(time.perf_counter() - started)
        precision = f"{estimator.device}, {estimator.precision}"
        print(f"{name:12} {count / min(seconds):12,.0f} pixels/s  ({precision})")


if __name__ == "__main__":
    main()
