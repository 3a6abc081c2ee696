"""Measure heights from estimated normals: of measured objects, and of flat things.

    python benchmarks/surfaces.py DATA [--draws 2]
    python benchmarks/surfaces.py --flat [--size 96] [--method spline-net]

With DATA, it has the folders depth and DiLiGenT/pmsData. The mean absolute error of the depth in
millimetres, after scaling by the median ratio, is printed for the true normals and for those
estimated under draws of ten lights (seed 0).

With --flat, a plate, a coin and an inscription are rendered under rings, domes and handheld lights
whose directions are known: with equal lamps, with intensities that differ by up to 50 % and are not
given, and with lamps at four widths that are taken for distant, or whose positions are known. The
mean absolute error of the heights is printed in percent of the relief's height, for lamps without
intensities and near lamps also once levelled, with the tilt that was removed in degrees.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from near_lamps import FLAT, Bench
from splinecli.capture import Capture, open_capture, read_normal_map
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.images.lamps import estimate_light_intensities
from splinecli.lights.draws import draw_lights
from splinecli.recipe import RecipeOptions, prepare_capture
from splinecli.surface.integration import integrate_normals
from splinecli.surface.levelling import level_heights, plane_slopes

OBJECTS = {"Bear": None, "Cat": "catPNG", "Reading": "readingPNG"}
"""The captures of the measured depths; there are no photographs of Bear."""
METHODS = ("ls", "spline-net-pixelwise", "spline-net")
WIDTHS = 4.0
"""Distance of the near lamps, in widths of the object."""

Cells = dict[str, float]


def measured_depths(data: Path, label: str, draws: int) -> Cells:
    """Return the errors of an object's depth in millimetres."""
    folder = data / "depth" / label.lower()
    with np.load(folder / "depth_gt.npz") as file:
        truth = np.asarray(next(iter(file.values())), np.float64)
    normals = read_normal_map(folder / "normal_map.png", folder / "mask.png", convention="opengl")
    camera = np.loadtxt(folder / "K.txt")
    mask = normals.any(axis=2)
    cells = {"true normals": depth_error_mm(normals, mask, camera, truth)}
    name = OBJECTS[label]
    if name is None:
        return cells
    source = open_capture(data / "DiLiGenT/pmsData" / name)
    stored = RecipeOptions(as_stored=True)
    for method in METHODS:
        errors, estimator = [], make_estimator(method)
        for draw in draw_lights(source.light_directions, 10, trials=draws, seed=0):
            found = estimate_normals(prepare_capture(source, draw, stored), estimator)
            # The photographs are cut out of the image to which camera and depth belong.
            row, column = place_of(found.capture.mask, mask)
            shifted = camera - np.array(((0, 0, column), (0, 0, row), (0, 0, 0)))
            inside = tuple(
                slice(start, start + size)
                for start, size in zip((row, column), found.capture.mask.shape, strict=True)
            )
            errors.append(
                depth_error_mm(found.normal_map, found.capture.mask, shifted, truth[inside])
            )
        cells[method] = fmean(errors)
    return cells


def place_of(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the row and column of `whole` at which the masks have most pixels in common.

    If one mask is a pixel wider all around, several places have; theirs is the mean.
    """
    from scipy.signal import fftconvolve

    common = fftconvolve(whole.astype(float), part[::-1, ::-1].astype(float), "valid")
    row, column = np.argwhere(common > common.max() - 0.5).mean(axis=0).round().astype(int)
    return int(row), int(column)


def depth_error_mm(
    normals: NDArray[np.float32],
    mask: NDArray[np.bool_],
    camera: NDArray[np.float64],
    truth: NDArray[np.float64],
) -> float:
    depth = integrate_normals(normals, mask, camera)
    known = mask & (truth > 0)
    found, true = depth[known], truth[known]
    return float(np.abs(found * np.median(true / found) - true).mean())


def lights(setup: str) -> NDArray[np.float64]:
    """Return the directions (F, 3) of a ring of 12, a dome of 24, or 16 handheld lights."""
    azimuth: NDArray[np.floating]
    zenith: NDArray[np.floating]
    if setup == "ring":
        azimuth, zenith = np.arange(12) / 12 * 360, np.full(12, 45.0)
    elif setup == "dome":
        azimuth, zenith = np.arange(24) * 137.5, np.degrees(np.arccos(np.linspace(0.98, 0.4, 24)))
    else:  # on one side more than on the other, as by hand
        rng = np.random.default_rng(4)
        azimuth, zenith = rng.normal(60, 100, 16), rng.uniform(15, 65, 16)
    around, tilt = np.radians(azimuth), np.radians(zenith)
    return np.stack(
        (np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)), axis=1
    )


def flat_things(method: str, size: int) -> Iterator[tuple[str, Cells]]:
    """Yield the name of each scene and its errors in percent of the height of the relief."""
    estimator = make_estimator(method)
    for shape in FLAT:
        for setup in ("ring", "dome", "handheld"):
            bench = Bench(shape, size, glossy=False, directions=lights(setup))
            distant, near = bench.under_distant_lights(), WIDTHS * bench.width
            cells: Cells = {}
            for name, capture in (
                ("distant", distant),
                ("unequal", unequal(distant)),
                ("near", bench.under_lamps(near, off=None)),
                ("near, given", bench.under_lamps(near, off=1.0)),
            ):
                found = estimate_normals(capture, estimator).normal_map
                heights = integrate_normals(found, capture.mask)
                cells[name] = error_percent(heights, bench.heights)
                if name in ("unequal", "near"):
                    slopes = plane_slopes(heights)
                    levelled = level_heights(heights, slopes)
                    cells[f"{name}, levelled"] = error_percent(levelled, bench.heights)
                    cells[f"{name}, tilt in degrees"] = float(
                        np.degrees(np.arctan(np.hypot(*slopes)))
                    )
            yield f"{shape}, {setup}", cells


def unequal(capture: Capture) -> Capture:
    """Return a capture of lamps that differ by up to 50 %, with the estimated intensities."""
    observations, directions = capture.observations, capture.light_directions
    factors = np.random.default_rng(2).uniform(0.5, 1.5, len(directions)).astype(np.float32)
    observations = observations * factors
    estimated = estimate_light_intensities(observations, None, directions)
    if estimated is not None:
        observations = (observations / estimated).astype(np.float32)
    return replace(capture, observations=observations)


def error_percent(heights: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    known = np.isfinite(heights + truth)
    error = (heights - truth)[known]
    return 100 * float(np.abs(error - np.median(error)).mean() / np.ptp(truth[known]))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--method", default="spline-net")
    options = parser.parse_args(arguments)
    if options.flat:
        rows = flat_things(options.method, options.size)
    elif options.data is not None:
        rows = ((label, measured_depths(options.data, label, options.draws)) for label in OBJECTS)
    else:
        parser.error("give DATA or --flat")
    for label, cells in rows:
        print(f"{label}: " + ", ".join(f"{name} {cell:.3f}" for name, cell in cells.items()))


if __name__ == "__main__":
    main()
