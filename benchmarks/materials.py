"""How accurate estimated materials are, on rendered scenes.

python benchmarks/materials.py [--seed 7001] [--scenes 20] [--size 64] [--sets diffuse-2 specular-2
                               metallic-2] [--method spline-net]

Each scene is rendered in each of the sets of materials under 40 lights, of which ten are drawn. The
normals are the true ones, or those of a method. A highlight is observable in a pixel if, under one
of the ten lights, the facets' distribution reaches half of its peak and the facets give 15 % of the
observation. Prints the mean absolute error of roughness, the share of pixels whose metalness is
right at a threshold of 0.5, and the mean and median relative error of the base, up to one factor
for each scene; a single error counts as 1 at most. Then prints how well pictures under the other 30
lights agree with the rendered ones, for the material and for a matte surface.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.estimate.inference import estimate_normals, lighting_on
from splinecli.estimate.methods import make_estimator
from splinecli.evaluation.figures import lambertian, likeness
from splinecli.materials.lobes import Geometry
from splinecli.materials.maps import estimate_material, lights_that_reach, render_gray
from splinecli.workshop.synthesis.principled import PrincipledMaterial
from splinecli.workshop.synthesis.ray_tracing import Tracer, find_visible_surface
from splinecli.workshop.synthesis.scenes import (
    RenderedScene,
    Scene,
    SceneConfig,
    draw_scene,
    render_scene,
)

Floats = NDArray[np.float32]
DRAWN = 10


class Example(NamedTuple):
    """A scene in one set of materials."""

    name: str
    rendered: RenderedScene
    observations: Floats  # (P, F)
    lights: Floats  # (F, 3)
    true: PrincipledMaterial  # of the pixels
    drawn: NDArray[np.intp]


def examples(seed: int, scenes: int, config: SceneConfig, sets: Sequence[str]) -> Iterator[Example]:
    """Yield the examples, scene by scene."""
    rng = np.random.default_rng(5)
    for index in range(scenes):
        scene = draw_scene(seed, index, config)
        rendered = render_scene(scene, config)
        patches = patch_of_pixels(scene, config)
        for name in sets:
            drawn = np.sort(rng.choice(config.lights, DRAWN, replace=False))
            true = scene.materials[name].take(patches)
            yield Example(
                f"{index} {name}", rendered, rendered.observations[name], scene.lights, true, drawn
            )


def patch_of_pixels(scene: Scene, config: SceneConfig) -> torch.Tensor:
    """Return the patch in the middle of each pixel (P,)."""
    bend = None if scene.relief is None else scene.relief.bend
    visible = find_visible_surface(
        Tracer(scene.mesh), config.size, config.samples, bend, distance=scene.distance
    )
    patches = scene.patch_of_face[visible.samples.triangle].reshape(-1, visible.samples_per_pixel)
    return torch.from_numpy(np.sort(patches, axis=1)[:, visible.samples_per_pixel // 2])


def observable(given: Capture, normals: Floats, true: PrincipledMaterial) -> NDArray[np.bool_]:
    """Return in which pixels (P,) a highlight is observable; see above."""
    directions = torch.from_numpy(given.light_directions.astype(np.float32))
    n_dot_l, n_dot_v, l_dot_v, _ = Geometry.of(
        torch.from_numpy(normals), directions, torch.zeros(len(normals))
    )
    n_dot_h = ((n_dot_l + n_dot_v) / (2 * (1 + l_dot_v)).sqrt()).clamp(0, 1)
    alpha_squared = (true.roughness**4).clamp(min=1e-4)
    lobe = (alpha_squared / (n_dot_h**2 * (alpha_squared - 1) + 1)) ** 2
    f0 = 0.08 * true.specular * (1 - true.metallic) + true.base * true.metallic

    def smith(cosine: torch.Tensor) -> torch.Tensor:
        return 1 / (cosine + (alpha_squared + (1 - alpha_squared) * cosine**2).sqrt())

    lit = n_dot_l.clamp(min=0)
    facets = f0 * lobe / alpha_squared * smith(lit) * smith(n_dot_v) * lit
    seen = (
        (lobe >= 0.5) & (n_dot_l > 0.05) & (facets >= 0.15 * torch.from_numpy(given.observations))
    )
    return seen.any(1).numpy()


def judge(example: Example, method: str | None) -> tuple[Floats, Floats]:
    """Return a row of errors for each pixel (P, 6), and of the relighting (5,)."""
    name, rendered, observations, lights, true, drawn = example
    given = Capture(
        name=name,
        mask=rendered.mask,
        observations=np.ascontiguousarray(observations[:, drawn]),
        light_directions=lights[drawn].astype(np.float64),
        light_indices=tuple(map(int, drawn)),
    )
    normals, confidence, error_deg = (
        rendered.normals,
        np.full(len(rendered.normals), 0.999, np.float32),
        0.0,
    )
    if method is not None:
        found_normals = estimate_normals(given, make_estimator(method))
        normals = found_normals.normal_map[rendered.mask]
        confidence = None
        if found_normals.confidence_map is not None:
            confidence = found_normals.confidence_map[rendered.mask]
        cosine = (normals * rendered.normals).sum(axis=1).clip(-1, 1)
        error_deg = math.degrees(float(np.arccos(cosine).mean()))
    found = estimate_material(
        rendered.mask,
        normals,
        given.light_directions,
        partial(lighting_on(given), None),
        normal_confidence=confidence,
    )
    base = found.base_colour[:, 0]
    base = base * np.median(true.base[:, 0].numpy() / base.clip(1e-6))
    columns = (
        np.abs(found.roughness - true.roughness[:, 0].numpy()),
        (found.metalness > 0.5) == (true.metallic[:, 0].numpy() > 0.5),
        np.abs(base / true.base[:, 0].numpy() - 1).clip(max=1),
        observable(given, rendered.normals, true),
        found.confidence,
        found.trust,
    )
    held = [place for place in range(len(lights)) if place not in given.light_indices]
    normal_map = np.zeros((*rendered.mask.shape, 3), np.float32)
    normal_map[rendered.mask] = normals
    reached = lights_that_reach(normal_map, rendered.mask, lights[held])
    ours = likeness(
        observations[:, held], render_gray(found, normals, lights[held], reached, confidence)
    )
    matte = likeness(observations[:, held], lambertian(given, normals, lights[held]) * reached)
    print(
        f"{name}: normals {error_deg:.1f} degrees, material {ours.psnr_db} dB, {ours.error:.3f};"
        f" matte {matte.psnr_db} dB, {matte.error:.3f}",
        flush=True,
    )
    return np.stack(columns, axis=1), np.array(
        (ours.psnr_db, ours.error, matte.psnr_db, matte.error, error_deg)
    )


def report(rows: Sequence[tuple[Floats, Floats]]) -> None:
    """Print the tables."""
    table = np.concatenate([pixels for pixels, _ in rows])
    seen, confidence = table[:, 3] == 1, table[:, 4]
    parts = {"all": seen | True, "highlight observable": seen}
    parts |= {
        "confidence 0.7 and more": confidence >= 0.7,
        "confidence below 0.1": confidence < 0.1,
    }
    print(
        "| pixels | share | roughness | metalness right | base, mean | base, median"
        " |\n|---|---:|---:|---:|---:|---:|"
    )
    for words, part in parts.items():
        roughness, metal, base = table[part, :3].T if part.any() else np.full((3, 1), np.nan)
        cells = (part.mean(), roughness.mean(), metal.mean(), base.mean(), np.median(base))
        print(f"| {words} | " + " | ".join(f"{cell:.3f}" for cell in cells) + " |")
    relit = np.stack([scene for _, scene in rows])
    gain, less = relit[:, 0] - relit[:, 2], relit[:, 3] - relit[:, 1]
    print(
        f"normals {relit[:, 4].mean():.2f} degrees; material {relit[:, 0].mean():.2f} dB,"
        f" {relit[:, 1].mean():.4f};"
    )
    print(
        f"matte {relit[:, 2].mean():.2f} dB, {relit[:, 3].mean():.4f}; gain {gain.mean():.2f} dB,"
        f" {less.mean():.4f},"
    )
    print(
        f"least {gain.min():.2f} dB, {less.min():.4f}; worse in {np.mean(gain < 0):.0%} and"
        f" {np.mean(less < 0):.0%}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=7001)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--sets", nargs="+", default=["diffuse-2", "specular-2", "metallic-2"])
    parser.add_argument("--method", default=None)
    options = parser.parse_args(arguments)
    config = SceneConfig(size=options.size, lights=40, samples=2, directions=24, bounces=2)
    found = examples(options.seed, options.scenes, config, options.sets)
    report([judge(example, options.method) for example in found])


if __name__ == "__main__":
    main()
