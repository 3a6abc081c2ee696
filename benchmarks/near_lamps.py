"""What near lamps cost, and what their positions win back, on rendered captures.

    python benchmarks/near_lamps.py [--size 96] [--method iw12] [--widths 2 4 8] [--off 0.8 1.2]

Renders a sphere, a relief and a plane under ten points of light at some distances, in widths of the
object, and under distant lights of the same directions. Prints the mean angular error in degrees
under distant lights; then for each distance that of lights taken as distant ("no"), of near lamps
at their true distance ("yes"), and at a distance that is wrong by these factors. For the plane,
also the range of its heights in percent of its width.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from point_lights import render_point_lights
from splinecli.capture import Capture
from splinecli.capture.near_lamps import NearLamps
from splinecli.estimate.inference import NormalEstimate, estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.surface.integration import integrate_normals
from splinecli.workshop.synthesis.meshes import Mesh
from splinecli.workshop.synthesis.principled import PrincipledMaterial
from splinecli.workshop.synthesis.ray_tracing import Tracer, VisibleSurface, find_visible_surface
from splinecli.workshop.synthesis.scenes import render_direct

# Angles of the ten lamps from the viewing direction and azimuths in degrees, as placed by hand.
LAMPS_DEG = (
    (18, 75),
    (22, 200),
    (26, 318),
    (40, 15),
    (44, 62),
    (38, 118),
    (48, 160),
    (42, 222),
    (52, 268),
    (46, 330),
)

SAMPLES = 3
"""Samples along a side of a pixel."""


def light_directions() -> NDArray[np.float64]:
    tilt, azimuth = np.radians(np.array(LAMPS_DEG, np.float64)).T
    return np.stack(
        (np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)), axis=1
    )


def _edge(inside: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a step from 0 to 1 over a distance of 0.06, the width of a slope."""
    return np.clip(inside / 0.06 + 0.5, 0, 1)


FLAT = {
    "plate": lambda x, y: 0.04 * _edge(np.maximum(abs(x), abs(y)) - 0.85),
    "coin": lambda x, y: (
        0.05 * _edge(np.hypot(x, y) - 0.8)
        + 0.05 * np.sqrt(np.maximum(0, 1 - (x / 0.35) ** 2 - ((y - 0.05) / 0.45) ** 2))
        + 0.02 * _edge(0.06 - abs(np.hypot(x, y) - 0.65)) * (np.cos(24 * np.arctan2(y, x)) > 0)
    ),
    # rows of letters made of strokes
    "inscription": lambda x, y: (
        -0.04
        * _edge(0.05 - abs(np.abs((4 * x + 0.5) % 1 - 0.5) / 4 - 0.06))
        * _edge(0.11 - abs((2.5 * y + 0.5) % 1 - 0.5) / 2.5)
        * (np.hypot(x, y) < 2)
    ),
}
"""Heights of flat things over the camera's square: a rim, a head with a rim and marks, strokes."""


def height_field(name: str, count: int = 401) -> Mesh:
    """Return a mesh over the camera's square, with exact normals; the sphere's edge falls off to a
    plane far below.
    """
    place = np.linspace(-1.05, 1.05, count)
    x, y = np.meshgrid(place, place)
    zero = np.zeros_like(x)
    heights, slope_x, slope_y = zero, zero, zero
    if name == "relief":
        heights = 0.12 * np.sin(5 * x) * np.cos(4 * y)
        slope_x, slope_y = (
            0.6 * np.cos(5 * x) * np.cos(4 * y),
            -0.48 * np.sin(5 * x) * np.sin(4 * y),
        )
    if name in FLAT:
        heights = FLAT[name](x, y)
        slope_y, slope_x = np.gradient(heights, place[1] - place[0])
    normals = np.stack((-slope_x, -slope_y, zero + 1), axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    first = np.stack((corner, corner + 1, corner + count), axis=1)
    second = np.stack((corner + 1, corner + count + 1, corner + count), axis=1)
    vertices = np.stack((x, y, heights), axis=-1).reshape(-1, 3)
    faces = np.concatenate((first, second))
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32))


def sphere(radius: float = 0.9, count: int = 300) -> Mesh:
    """Return a sphere of meridians and parallels, with exact normals."""
    polar, azimuth = np.meshgrid(
        np.linspace(0.002, np.pi - 0.002, count), np.linspace(0, 2 * np.pi, 2 * count)
    )
    normals = np.stack(
        (np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)), axis=-1
    ).reshape(-1, 3)
    corner = (np.arange(2 * count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    first = np.stack((corner, corner + 1, corner + count), axis=1)
    second = np.stack((corner + 1, corner + count + 1, corner + count), axis=1)
    faces = np.concatenate((first, second)).astype(np.int32)
    return Mesh((radius * normals).astype(np.float32), faces, normals.astype(np.float32))


def material(*, glossy: bool) -> PrincipledMaterial:
    """Return a matte paint, or a plastic with clear highlights."""

    def one(value: float) -> torch.Tensor:
        return torch.full((1, 1), value)

    return PrincipledMaterial(
        base=one(0.5),
        metallic=one(0.0),
        specular=one(0.5 if glossy else 0.05),
        roughness=one(0.35 if glossy else 0.9),
        sheen=one(0.0),
        clearcoat=one(0.0),
        clearcoat_gloss=one(0.0),
        interface_loss=one(0.0),
        minnaert=one(1.0),
        tail_exponent=one(2.0),
        second_share=one(0.0),
        second_roughness=one(1.0),
        retro=one(0.0),
    )


class Bench:
    """One shape of one material, rendered under lamps in these directions (F, 3)."""

    def __init__(
        self,
        name: str,
        size: int,
        *,
        glossy: bool,
        directions: NDArray[np.float64] | None = None,
    ) -> None:
        self.name = name
        self._directions = light_directions() if directions is None else directions
        mesh = sphere() if name == "sphere" else height_field(name)
        self._tracer = Tracer(mesh)
        self._visible: VisibleSurface = find_visible_surface(self._tracer, size, SAMPLES)
        self._patches = np.zeros(len(mesh.faces), np.int64)
        self._materials = {"one": material(glossy=glossy)}
        mask = self._visible.mask
        self.width = np.ptp(np.flatnonzero(mask.any(axis=0))) * 2 / size
        # The origin of the positions is on the mean plane of the object.
        self._mean = np.array((0, 0, self._visible.samples.position[:, 2].mean(dtype=np.float64)))
        self._truth = np.zeros((*mask.shape, 3), np.float32)
        self._truth[mask] = self._visible.normals

    @property
    def heights(self) -> NDArray[np.float64]:
        """The mean heights (H, W) of the pixels, in pixels."""
        mask, samples = self._visible.mask, self._visible.samples.position[:, 2]
        heights = np.full(mask.shape, np.nan)
        pixels = samples.reshape(-1, self._visible.samples_per_pixel).mean(axis=1)
        heights[mask] = pixels * len(mask) / 2
        return heights

    def under_distant_lights(self) -> Capture:
        lights = self._directions.astype(np.float32)
        images = render_direct(self._tracer, self._visible, lights, self._materials, self._patches)[
            "one"
        ]
        return self._capture(images)

    def under_lamps(self, distance: float, *, off: float | None) -> Capture:
        """Return the capture with lamps at a distance. It says that they are at `off` times that;
        None is distant.
        """
        positions = self._directions * distance
        images = render_point_lights(
            self._tracer, self._visible, positions + self._mean, self._materials, self._patches
        )["one"]
        # All lamps are equally strong; the renderer's unit of radiance differs from lamp to lamp.
        images /= torch.from_numpy(np.sum((positions + self._mean) ** 2, axis=1) / distance**2)
        capture = self._capture(images)
        if off is None:
            return capture
        size = len(capture.mask)
        lamps = NearLamps.of(positions * off, 2 / size, (size, size), equal=True)
        return replace(capture, lamps=lamps)

    def _capture(self, images: torch.Tensor) -> Capture:
        directions = self._directions
        return Capture(
            self.name,
            images.numpy(),
            directions,
            tuple(range(len(directions))),
            self._visible.mask,
            self._truth,
        )


def height_range_percent(estimate: NormalEstimate) -> float:
    """Return the range of the integrated heights in percent of the width of the image."""
    mask = estimate.capture.mask
    return 100 * float(np.ptp(integrate_normals(estimate.normal_map, mask)[mask])) / mask.shape[1]


Cell = tuple[float, float | None]
"""Mean angular error in degrees, and for the plane the range of its heights in percent."""


def measure(
    method: str, size: int, widths: Sequence[float], off: Sequence[float]
) -> Iterator[tuple[str, list[tuple[str, Cell]]]]:
    """Yield the name of each scene, and its cells with their names."""
    estimator = make_estimator(method)

    def cell(capture: Capture) -> Cell:
        estimate = estimate_normals(capture, estimator)
        assert estimate.errors is not None
        heights = height_range_percent(estimate) if capture.name == "plane" else None
        return estimate.errors.mean, heights

    names = {"no": None, "yes": 1.0, **{f"x {factor:g}": factor for factor in off}}
    for shape in ("sphere", "relief", "plane"):
        for glossy in (False, True):
            bench = Bench(shape, size, glossy=glossy)
            cells = [("distant", cell(bench.under_distant_lights()))]
            for width in widths:
                for name, factor in names.items():
                    capture = bench.under_lamps(width * bench.width, off=factor)
                    cells.append((f"{width:g}: {name}", cell(capture)))
            yield f"{'glossy' if glossy else 'matte'} {shape}", cells


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--method", default="iw12")
    parser.add_argument("--widths", type=float, nargs="+", default=[2, 4, 8])
    parser.add_argument("--off", type=float, nargs="*", default=[0.8, 1.2])
    options = parser.parse_args(arguments)
    print(f"{options.method}, {options.size} x {options.size} pixels")
    columns: list[str] = []
    for scene, cells in measure(options.method, options.size, options.widths, options.off):
        if not columns:
            columns = ["scene", *(name for name, _ in cells)]
            print("  ".join(f"{text:>14}" for text in columns))
        texts = (
            f"{mae:.2f}" + ("" if high is None else f" ({high:.1f} %)") for _, (mae, high) in cells
        )
        print("  ".join(f"{text:>14}" for text in (scene, *texts)), flush=True)


if __name__ == "__main__":
    main()
