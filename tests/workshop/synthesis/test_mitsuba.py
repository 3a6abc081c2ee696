"""Rendered scenes against Mitsuba 3's path tracer, where that is installed (pip install mitsuba).

The full comparison is benchmarks/render_accuracy.py; here a small image under two lights is enough
to catch a wrong lobe, factor, frame or bounce.
"""

import importlib
from dataclasses import replace

import numpy as np
import pytest

from scenes import vectors
from splinecli.maths.normals import unit
from splinecli.workshop.synthesis.meshes import (
    fit_to_frame,
    moved,
    smooth_cut,
    smooth_union,
    split_long_edges,
    torus,
    triangulate,
)
from splinecli.workshop.synthesis.scenes import SceneConfig, draw_scene, render_scene

pytest.importorskip("embreex")
from workshop.synthesis.test_rendering import mesh_of

mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba is the oracle")

SIZE, SAMPLES = 32, 256
CONFIG = SceneConfig(size=SIZE, samples=4, directions=256)
# Pixels along the edge of the blocks whose means are compared: single pixels are noise above all,
# of either side.
BLOCK = 4


@pytest.fixture(scope="module")
def benchmark():
    mitsuba.set_variant("scalar_rgb")
    return importlib.import_module("render_accuracy")


def bowl_with_ring():
    """A deep bowl, of which most is lit by the rest of it, and a ring in it that throws shadows."""

    def distance(points):
        radius = np.linalg.norm(points, axis=1)
        above = points[:, 2] + np.float32(0.1)
        shell = smooth_cut(
            radius - np.float32(0.9), np.maximum(radius - np.float32(0.78), -1), 0.03
        )
        bowl = smooth_cut(shell, -above, 0.05)
        ring = moved(
            torus(0.35, 0.1), np.eye(3, dtype=np.float32), np.array((0.2, 0.1, -0.3), np.float32)
        )
        return smooth_union(bowl, ring(points), 0.05)

    return fit_to_frame(triangulate(distance, (1.0, 1.0, 1.0), 0.03))


@pytest.fixture(scope="module")
def scene(benchmark):
    # Of the first scenes of this seed one with a few patches: edges inside pixels are noise at this
    # size.
    mesh = bowl_with_ring()
    drawn = (draw_scene(3, index, CONFIG, mesh) for index in range(100))
    few = next(one for one in drawn if 3 <= one.patch_of_face.max() + 1 <= 20)
    comparable = benchmark.comparable(few)
    # Sharp lobes that light each other are noise in a path tracer, until it has thousands of
    # samples.
    blunt = {
        name: replace(one, roughness=one.roughness.clamp(min=0.4))
        for name, one in comparable.materials.items()
    }
    return replace(comparable, materials=blunt)


@pytest.fixture(scope="module")
def rendered(scene):
    """By the number of bounces."""
    return {bounces: render_scene(scene, replace(CONFIG, bounces=bounces)) for bounces in (0, 4)}


def block_means(values, mask):
    """Means over the blocks of pixels that lie in the mask as a whole (N,)."""
    image = np.zeros(mask.shape, np.float32)
    image[mask] = values

    def blocks(pixels):
        return pixels.reshape(SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK)

    inside = blocks(mask).all(axis=(1, 3))
    return blocks(image).mean(axis=(1, 3))[inside]


@pytest.mark.parametrize(
    "name, bounces, most_off",
    [("diffuse", 4, 0.04), ("specular", 0, 0.04), ("specular", 4, 0.04), ("metallic", 4, 0.06)],
)
def test_images_agree(scene, rendered, benchmark, name, bounces, most_off):
    ours = rendered[bounces]
    shapes = benchmark.mitsuba_shapes(scene, name)
    mine, theirs = [], []
    for light in (1, 2):
        image = benchmark.render_with_mitsuba(
            shapes, SIZE, SAMPLES, scene.lights[light], depth=bounces + 2
        )
        theirs.append(block_means(image[ours.mask], ours.mask))
        mine.append(block_means(ours.observations[name][:, light], ours.mask))
    difference = np.abs(np.concatenate(mine) - np.concatenate(theirs))
    assert len(difference) > 40
    assert difference.mean() < most_off * np.mean(theirs)
    assert np.mean(mine) == pytest.approx(np.mean(theirs), rel=0.02)


def corner():
    """Two plates that meet at a right angle in a valley along y, open to the camera."""
    left, right = "-1 -1 1; 0 -1 0; 0 1 0; -1 1 1", "0 -1 0; 1 -1 1; 1 1 1; 0 1 0"
    normals = np.repeat(np.sqrt(0.5) * vectors("1 0 1; -1 0 1"), 4, axis=0)
    mesh = mesh_of(f"{left}; {right}", "0 1 2; 0 2 3; 4 5 6; 4 6 7", normals)
    return split_long_edges(mesh, longest=0.03)


def test_glossy_plates_mirror_each_other_sharply(benchmark):
    """Most of the light of this metal was reflected twice. With blunt lobes, it is in the wrong
    places.
    """
    lights = vectors("0.3 0.2 0.9; 0.6 0.1 0.75; 0.05 -0.1 1").astype(np.float32)
    lights = unit(lights)
    drawn = benchmark.comparable(draw_scene(3, 0, CONFIG, corner()))
    zero = drawn.materials["metallic"].base[:1] * 0
    metal = replace(
        drawn.materials["metallic"].take(slice(0, 1)),
        base=zero + 0.9,
        metallic=zero + 1,
        roughness=zero + 0.2,
        specular=zero + 0.5,
        sheen=zero,
    )
    faces = np.zeros(len(drawn.mesh.faces), np.int64)
    scene = replace(drawn, lights=lights, materials={"metallic": metal}, patch_of_face=faces)
    shapes = benchmark.mitsuba_shapes(scene, "metallic")
    images = [benchmark.render_with_mitsuba(shapes, SIZE, SAMPLES, light) for light in lights]
    config = replace(CONFIG, samples=3, directions=96)
    off = {}
    for sharp in (True, False):
        ours = render_scene(replace(scene, sharp=sharp), config)
        theirs = np.concatenate([block_means(image[ours.mask], ours.mask) for image in images])
        mine = np.concatenate(
            [block_means(ours.observations["metallic"][:, n], ours.mask) for n in range(3)]
        )
        off[sharp] = np.abs(mine - theirs).mean() / theirs.mean()
    assert off[True] < 0.08
    assert off[False] > 0.4
