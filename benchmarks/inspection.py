"""Detection of dents and scratches on a printed, glossy plate, by `--maps relief` and `--maps
curvature`.

    python benchmarks/inspection.py
    python benchmarks/inspection.py --picture docs/pictures/inspection.png

Each plate is slightly curved, rough, printed in two tones, and has four defects. Ten lights, noise
of 0.4 % of white. A defect is found where a map exceeds the largest value on plates without
defects, so print and noise do not count.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from splinecli import estimate_normals
from splinecli.maths.normals import curvature_of_normals
from splinecli.pictures.maps import encode_png, signed_picture
from splinecli.surface.integration import relief_of_normals

Floats = NDArray[np.float64]

AZIMUTH = 2 * np.pi * np.arange(10) / 10
LIGHTS = np.stack(
    (np.cos(AZIMUTH) * np.sin(0.8), np.sin(AZIMUTH) * np.sin(0.8), np.full(10, np.cos(0.8))), axis=1
)
PLACES = ((0.25, 0.27), (0.73, 0.28), (0.28, 0.75), (0.76, 0.73))
DENT_SIGMA, SCRATCH_SIGMA, SCRATCH_LENGTH = 6.0, 1.2, 36.0  # pixels
BORDER = 15  # pixels at the edge that are not judged


def photograph(
    size: int, kind: str, depth: float, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return images (F, H, W) of a plate, and where its defects are,
    which are `depth` pixels deep.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size].astype(float)
    height = 2e-4 * ((x - size / 2) ** 2 + (y - size / 2) ** 2)
    height += 0.02 * gaussian_filter(rng.normal(size=x.shape), 1.5)
    defects = np.zeros(x.shape, bool)
    for right, down in PLACES:
        turn, dx, dy = rng.uniform(0, np.pi), x - right * size, y - down * size
        along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
        if kind == "dent":
            shape = np.exp(-(dx**2 + dy**2) / (2 * DENT_SIGMA**2))
        else:
            shape = np.exp(-(across**2) / (2 * SCRATCH_SIGMA**2)) * (
                np.abs(along) < SCRATCH_LENGTH / 2
            )
        height -= depth * shape
        defects |= shape > 0.5
    by_row, by_column = np.gradient(height)
    normals = np.stack((-by_column, by_row, np.ones_like(height)), axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    halfway = LIGHTS + np.array([0, 0, 1])
    halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
    print_ = np.where(gaussian_filter(rng.normal(size=x.shape), 4) > 0, 0.7, 0.15)
    images = (
        print_[..., None] * (normals @ LIGHTS.T).clip(0)
        + 0.25 * (normals @ halfway.T).clip(0) ** 40
    )
    images += rng.normal(scale=0.004, size=images.shape)
    return images.clip(0).astype(np.float32).transpose(2, 0, 1), defects


def maps_of(images: NDArray[np.float32], method: str) -> dict[str, NDArray[np.float32]]:
    """Return relief and mean curvature, (H, W) each."""
    estimate = estimate_normals(
        images, LIGHTS, light_intensities=np.ones(len(LIGHTS)), method=method
    )
    whole = np.ones(images.shape[1:], bool)
    return {
        "relief": relief_of_normals(estimate.normal_map, whole),
        "curvature": curvature_of_normals(estimate.normal_map, whole)[..., 0],
    }


def sizes_of(images: NDArray[np.float32], method: str) -> dict[str, NDArray[np.float32]]:
    """Return how far relief and mean curvature are from their medians, (H, W) each;
    0 at the edge.
    """
    mask = np.zeros(images.shape[1:], bool)
    mask[BORDER:-BORDER, BORDER:-BORDER] = True
    return {
        name: np.abs(values - np.median(values)) * mask
        for name, values in maps_of(images, method).items()
    }


def picture_of(size: int, depth: float, method: str) -> bytes:
    """Return a PNG picture: a plate with dents, and one with scratches below; photograph, relief
    and curvature.
    """
    rows = []
    for kind in ("dent", "scratch"):
        images, _ = photograph(size, kind, depth, 200)
        maps = maps_of(images, method)
        photo = np.rint(255 * (images[0] / images[0].max()) ** (1 / 2.2)).astype(np.uint8)
        everywhere = np.ones(photo.shape, np.bool_)
        curvature = signed_picture(maps["curvature"], everywhere, 0.02)
        relief = signed_picture(maps["relief"], everywhere, 0.5)
        rows.append(np.hstack((photo, relief, curvature)))
    return encode_png(np.vstack(rows))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--plates", type=int, default=2)
    parser.add_argument("--depths", type=float, nargs="+", default=(0.05, 0.1, 0.2, 0.5))
    parser.add_argument("--method", default="spline-net")
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="write a picture of plates, and measure nothing",
    )
    args = parser.parse_args(arguments)
    if args.picture is not None:
        args.picture.write_bytes(picture_of(args.size, 0.2, args.method))
        return
    flat = [
        sizes_of(photograph(args.size, "dent", 0, 100 + plate)[0], args.method)
        for plate in range(args.plates)
    ]
    limits = {name: max(float(maps[name].max()) for maps in flat) for name in flat[0]}
    print("| defect | depth in pixels | relief | curvature |\n|---|---:|---:|---:|")
    for kind in ("dent", "scratch"):
        for depth in args.depths:
            found, count = dict.fromkeys(limits, 0), 0
            for plate in range(args.plates):
                images, defects = photograph(args.size, kind, depth, 200 + plate)
                maps, (numbers, n_defects) = sizes_of(images, args.method), label(defects)
                count += n_defects
                for name, limit in limits.items():
                    found[name] += len(set(numbers[maps[name] > limit]) - {0})
            print(
                f"| {kind} | {depth:g} | {found['relief']} of {count} | {found['curvature']} of"
                f" {count} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
