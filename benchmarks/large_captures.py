r"""Measure time and memory of `infer` against the size of the capture.

python benchmarks/large_captures.py [--megapixels 0.05 0.5 2 6 24] [--method spline-net] [--formats
    png,npy] \ [--plot FILE.png] [--avx2]

Each capture is a smooth bumpy relief with a glossy half: ten 16-bit RGB images in PNG files under
ten lights, with noise, all pixels in the mask. Each run is a process of its own. The table has the
seconds of the report (reading, estimating, writing), those of all processor cores together, and the
largest memory. On a busy machine, only the processor's seconds mean something, and they only beside
others of the same run. --plot draws these and the memory against the size. --avx2 measures a
processor without AVX-512 and bfloat16, as in most laptops.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

LIGHTS = 10
STAGES = ("read", "check", "distil", "estimate", "indirect_light", "refine", "write")
AVX2 = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "DNNL_MAX_CPU_ISA": "AVX2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
}
COLOUR = np.array((0.8, 1.0, 0.7), np.float32)


def directions() -> NDArray[np.float32]:
    """Return lights (10, 3) on a spiral, 10 to 50 degrees from the view axis."""
    azimuth, zenith = 2.4 * np.arange(LIGHTS), np.radians(np.linspace(10, 50, LIGHTS))
    xy = np.sin(zenith) * (np.cos(azimuth), np.sin(azimuth))
    return np.stack((*xy, np.cos(zenith)), axis=1).astype(np.float32)


def relief(height: int, width: int) -> NDArray[np.float32]:
    """Return the unit normals (H, W, 3) of a bumpy relief, the same bumps at each size."""
    rng = np.random.default_rng(0)
    slopes = [
        cv2.resize(
            rng.normal(scale=0.7, size=(12, 18)).astype(np.float32),
            (width, height),
            interpolation=cv2.INTER_CUBIC,
        )
        for _ in range(2)
    ]
    length = np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)
    return np.stack((slopes[0] / length, slopes[1] / length, 1 / length), axis=-1)


def write_capture(folder: Path, megapixels: float) -> None:
    """Write a capture of about this size."""
    height = max(8, round((megapixels * 1e6 / 1.5) ** 0.5))
    width = round(1.5 * height)
    normals, rng = relief(height, width), np.random.default_rng(1)
    glossy = np.arange(width) > width / 2
    for number, light in enumerate(directions()):
        half = light + np.array((0, 0, 1), np.float32)
        half /= np.linalg.norm(half)
        shade = np.clip(normals @ light, 0, None)
        shade += glossy * 0.5 * np.clip(normals @ half, 0, None) ** 40
        shade += 0.003 * rng.standard_normal(shade.shape, np.float32)
        stored = (np.clip(shade[..., None] / 1.6 * COLOUR, 0, 1) * 65535).astype(np.uint16)
        cv2.imwrite(str(folder / f"{number:02d}.png"), stored)
    np.savetxt(folder / "light_directions.txt", directions())
    np.savetxt(folder / "light_intensities.txt", np.ones((LIGHTS, 3)))


def draw_plot(path: Path, rows: Sequence[tuple[float, float, float]]) -> None:
    """Draw processor seconds and memory in MiB against megapixels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    sizes, *columns = zip(*rows, strict=True)
    for axes, values, name in zip(
        figure.subplots(1, 2), columns, ("processor (s)", "memory (MiB)"), strict=True
    ):
        axes.plot(sizes, values, marker="o")
        axes.set(xlabel="megapixels", ylabel=name, xlim=(0, None), ylim=(0, None))
        axes.grid(visible=True, alpha=0.3)
    figure.savefig(path, dpi=100)


def measure(
    megapixels: float, method: str, formats: str, avx2: bool = False
) -> tuple[float, dict[str, Any]]:
    """Return the seconds of all processor cores that `infer` takes for a capture of this size, and
    its report.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "relief"
        folder.mkdir()
        write_capture(folder, megapixels)
        before = os.times()
        command = [sys.executable, "-m", "splinecli", "infer", str(folder), "-o", place, "--json"]
        command += ["--method", method, "--format", formats]
        command += ["--precision", "float32"] * avx2
        environment = {**os.environ, **(AVX2 if avx2 else {})}
        (report,) = json.loads(
            subprocess.run(command, check=True, capture_output=True, env=environment).stdout
        )
        after = os.times()
    used = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    return used, report


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.05, 0.5, 2, 6, 24])
    parser.add_argument("--method", default="spline-net")
    parser.add_argument("--formats", default="png,npy")
    parser.add_argument("--avx2", action="store_true")
    parser.add_argument("--plot", type=Path, help="a PNG file")
    options = parser.parse_args(arguments)
    rows = []
    print(
        "megapixels",
        *(f"{stage[:9]:>9}" for stage in STAGES),
        "    total processor    memory  unlike",
    )
    for megapixels in options.megapixels:
        processor, report = measure(megapixels, options.method, options.formats, options.avx2)
        width, height = report["image_size"]
        seconds, distilled = report["seconds"], report["distillation"]
        unlike = "exact" if distilled is None else distilled["unlike_pixels"]
        stages = " ".join(f"{seconds[stage]:7.1f} s" for stage in STAGES)
        sums = f"{seconds['total']:7.1f} s {processor:7.1f} s {report['peak_memory_mib']:5d} MiB"
        print(f"{width * height / 1e6:10.3f} {stages} {sums}  {unlike}", flush=True)
        rows.append((width * height / 1e6, processor, report["peak_memory_mib"]))
    if options.plot is not None:
        draw_plot(options.plot, rows)


if __name__ == "__main__":
    main()
