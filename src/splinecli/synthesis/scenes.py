"""Scenes for training, after CyclesPS (Ikehata, "CNN-PS", ECCV 2018).

A scene has one shape, three sets of materials in each of three classes, and directional lights over the whole upper
hemisphere. Additional materials take little time, because the light paths are the same. A scene depends only on (seed,
index), so an interrupted set can be continued.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.maths.normals import unit
from splinecli.synthesis.meshes import Floats, Mesh
from splinecli.synthesis.principled import CLASSES, PrincipledMaterial, draw_material, with_one_gloss
from splinecli.synthesis.ray_tracing import Tracer, find_visible_surface
from splinecli.synthesis.rendering import render_direct, render_indirect
from splinecli.synthesis.shapes import Relief, draw_detail, draw_shape, read_relief

MATERIALS = {f"{name}{suffix}": kinds for suffix in ("", "-2", "-3") for name, kinds in CLASSES.items()}
"""The material sets of a scene, each with the range of the number that selects the kind; see draw_material."""

MIN_LIGHT_Z = 0.03  # lowest z of a light, the cosine of its angle to the viewing direction


@dataclass(frozen=True)
class SceneConfig:
    """Settings for drawing and rendering scenes."""

    size: int = 128  # width and height in pixels
    lights: int = 100  # F, the number of lights
    samples: int = 3  # k of the k x k samples per pixel
    directions: int = 96  # number of paths per pixel for indirect light
    bounces: int = 4  # largest number of reflections before the visible surface; 0 for direct light only


@dataclass(frozen=True)
class Scene:
    """A scene before rendering."""

    shape: str  # kind of the shape
    mesh: Mesh  # the shape
    lights: Floats  # (F, 3), unit directions towards the lights
    materials: dict[str, PrincipledMaterial]  # by the names in MATERIALS, with one row per patch of the surface
    patch_of_face: NDArray[np.int64]  # (T,), the patch of each face
    seed: int  # seed of the paths of indirect light
    relief: Relief | None = None  # on the surface


@dataclass(frozen=True)
class RenderedScene:
    """The images of a scene."""

    mask: NDArray[np.bool_]  # (H, W)
    normals: Floats  # (P, 3), unit; pixels row-major
    # by the names in MATERIALS, (P, F) float32; 1 is a matte white surface that faces the light and fills the pixel
    observations: dict[str, Floats]


def draw_scene(
    seed: int, index: int, config: SceneConfig, mesh: Mesh | None = None, reliefs: Sequence[Path] = ()
) -> Scene:
    """Draw scene number `index` of the set with this seed, with the given mesh or, for None, a random shape.

    Half of the scenes get a relief from one of the normal maps, if any are given; see draw_detail.

    The surface has one patch in 60 % of the scenes, as real objects have one or few materials, 2 to 12 in 25 %, and 20
    to 3,000 in 15 %. In half of the scenes the patches differ only in their base colour, as on a painted or printed
    object of uniform gloss. Raises UsageError if the extra `render` is not installed.
    """
    rng = np.random.default_rng([seed, index])
    lights = draw_lights(config.lights, rng)
    kind = rng.random()
    patches = 1 if kind < 0.6 else int(rng.integers(2, 13) if kind < 0.85 else rng.integers(20, 3001))
    one_gloss = rng.random() < 0.5
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    render_seed = int(rng.integers(2**62))
    materials: dict[str, PrincipledMaterial] = {}
    for name, kinds in MATERIALS.items():
        material = draw_material(patches, generator, kinds)
        materials[name] = with_one_gloss(material) if one_gloss else material
    # Draw the shape last, because it needs a varying number of random values.
    # With multiples of the golden ratio, even a small set has several kinds of shapes.
    place = (np.random.default_rng(seed).random() + index * (np.sqrt(5) - 1) / 2) % 1
    shape, mesh = ("given", mesh) if mesh is not None else draw_shape(rng, place)
    patch_of_face = draw_patches(mesh, patches, rng)
    own = np.random.default_rng([seed, index, 1])
    relief = None
    if reliefs and own.random() < 0.5:
        relief = draw_detail(read_relief(reliefs[int(own.integers(len(reliefs)))]), config.size, own)
    return Scene(shape, mesh, lights, materials, patch_of_face, render_seed, relief)


def render_scene(scene: Scene, config: SceneConfig, progress: Callable[[float], None] | None = None) -> RenderedScene:
    """Render the scene in all its materials. `progress` is called with the finished share, from 0 to 1.

    Raises UsageError if the extra `render` is not installed.
    """
    report = progress or (lambda _: None)
    tracer = Tracer(scene.mesh)
    visible = find_visible_surface(
        tracer, config.size, config.samples, None if scene.relief is None else scene.relief.bend
    )
    parts = tracer, visible, scene.lights, scene.materials, scene.patch_of_face
    with torch.inference_mode():
        radiance = render_direct(*parts, progress=lambda share: report(0.4 * share))
        if config.bounces and len(visible.normals):
            indirect = render_indirect(
                *parts,
                directions=config.directions,
                bounces=config.bounces,
                generator=torch.Generator().manual_seed(scene.seed),
                progress=lambda share: report(0.4 + 0.6 * share),
            )
            for name, received in indirect.items():
                radiance[name] += received
    return RenderedScene(visible.mask, visible.normals, {name: values.numpy() for name, values in radiance.items()})


def draw_lights(count: int, rng: np.random.Generator) -> Floats:
    """Draw light directions (count, 3), about uniform over the upper hemisphere.

    They are a Fibonacci spiral (Gonzalez 2010), rotated by a random angle. Each light is then moved by a third of
    the mean distance.
    """
    order = np.arange(count)
    z = 1 - (1 - MIN_LIGHT_Z) * (order + 0.5) / count
    azimuth = order * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi)
    radius = np.sqrt(1 - z * z)
    directions = np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=1)
    directions += rng.normal(size=(count, 3)) * np.sqrt(2 * np.pi / count) / 3
    directions[:, 2] = np.maximum(directions[:, 2], MIN_LIGHT_Z * 1.5)
    return unit(directions).astype(np.float32)


def draw_patches(mesh: Mesh, patches: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw the patch of each face (T,), 0 to patches - 1: Voronoi cells around random faces."""
    from scipy.spatial import cKDTree

    centres = mesh.vertices[mesh.faces].mean(axis=1)
    seeds = centres[rng.integers(len(centres), size=patches)]
    return np.asarray(cKDTree(seeds).query(centres)[1], dtype=np.int64)
