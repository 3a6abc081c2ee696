"""How far rendered scenes are from Mitsuba 3's.

python benchmarks/render_accuracy.py [--size 96] [--samples 512] [--scenes 3] [--first 1000]
[--bounces 4]

Renders scenes that no default seed uses, in each class of materials under five lights from overhead
to low, and compares them with Mitsuba's path tracer (depth 6, principled BSDF), pixel by pixel: the
mean absolute difference over the mean. Normals are compared with Mitsuba's shading normals.
Mitsuba's own noise, from the difference of its two halves of samples, is part of what is printed.

Mitsuba takes one specular reflectance for a whole shape, so it is rounded to a few levels here, in
both.
"""

import argparse
import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.workshop.synthesis.draw_materials import CLASSES
from splinecli.workshop.synthesis.principled import PrincipledMaterial
from splinecli.workshop.synthesis.scenes import Scene, SceneConfig, draw_scene, render_scene

LEVELS = 6
# Cosines of the lights with the viewing direction, and their azimuths in degrees.
LIGHTS = ((0.95, 20), (0.75, 130), (0.55, 250), (0.35, 60), (0.15, 190))


def lights() -> NDArray[np.float32]:
    """The compared directions (5, 3)."""
    z, azimuth = np.array(LIGHTS).T
    radius, angle = np.sqrt(1 - z * z), np.radians(azimuth)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), z), axis=1).astype(np.float32)


def comparable(scene: Scene) -> Scene:
    """The scene under the compared lights, its materials within what Mitsuba has."""
    materials = {}
    for name, material in scene.materials.items():
        assert isinstance(material, PrincipledMaterial)
        zero = torch.zeros_like(material.base)
        highest = max(float(material.specular.max()), 1e-6)
        rounded = ((material.specular / highest * LEVELS).floor() + 0.5).clamp(max=LEVELS - 0.5)
        materials[name] = dataclasses.replace(
            material,
            specular=rounded * highest / LEVELS,
            # Ours is never smoother than this.
            roughness=material.roughness.clamp(min=0.1),
            # Mitsuba's coat has another scale, and it lacks the parameters that are not Burley's.
            clearcoat=zero,
            interface_loss=zero,
            minnaert=zero + 1,
            tail_exponent=zero + 2,
            second_share=zero,
            retro=zero,
        )
    return dataclasses.replace(scene, lights=lights(), materials=materials)


def mitsuba_shapes(scene: Scene, class_name: str) -> dict[str, Any]:
    """The mesh in parts of one specular reflectance each, with the other parameters on its
    faces.
    """
    import mitsuba as mi

    material = scene.materials[class_name]
    assert isinstance(material, PrincipledMaterial)
    specular = material.specular.numpy()[scene.patch_of_face, 0]
    shapes: dict[str, Any] = {}
    for number, level in enumerate(np.unique(specular)):
        kept = specular == level
        patches = scene.patch_of_face[kept]
        f0 = 0.08 * float(level)
        textures = {
            name: {"type": "mesh_attribute", "name": f"face_{name}"}
            for name in ("base", "metallic", "roughness", "sheen")
        }
        bsdf = mi.load_dict(
            {
                "type": "principled",
                "base_color": textures["base"],
                "roughness": textures["roughness"],
                "sheen": textures["sheen"],
                "metallic": textures["metallic"],
                "eta": (1 + f0**0.5) / (1 - f0**0.5),
            }
        )
        properties = mi.Properties()
        properties["bsdf"] = bsdf
        mesh = mi.Mesh(
            f"part{number}",
            len(scene.mesh.vertices),
            int(kept.sum()),
            properties,
            has_vertex_normals=True,
        )
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = scene.mesh.vertices.ravel()
        parameters["vertex_normals"] = scene.mesh.vertex_normals.ravel()
        parameters["faces"] = scene.mesh.faces[kept].ravel()
        parameters.update()
        for name in textures:
            values = getattr(material, name).numpy()[patches, 0]
            mesh.add_attribute(f"face_{name}", 1, values)
        shapes[f"part{number}"] = mesh
    return shapes


def render_with_mitsuba(
    shapes: dict[str, Any],
    size: int,
    samples: int,
    light: NDArray[np.float32] | None,
    *,
    depth: int = 6,
    seed: int = 0,
) -> NDArray[np.float32]:
    """Image (H, W) under a light (3,), or without one the sum of the samples' shading normals (H,
    W, 3).
    """
    import mitsuba as mi

    world = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    scene: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "orthographic",
            "to_world": world,
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent", "sample_count": samples},
        },
        **shapes,
    }
    if light is None:
        scene["integrator"] = {"type": "aov", "aovs": "normals:sh_normal"}
    else:
        scene["integrator"] = {"type": "path", "max_depth": depth, "rr_depth": 100}
        scene["light"] = {
            "type": "directional",
            "direction": [-float(value) for value in light],
            # White and matte that faces the light sends back 1 / pi of it.
            "irradiance": {"type": "rgb", "value": [float(np.pi)] * 3},
        }
    image = np.array(mi.render(mi.load_dict(scene), spp=samples, seed=seed))
    return image[..., -3:] if light is None else image[..., :3].mean(axis=-1)


def main(arguments: Sequence[str] | None = None) -> None:
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    parser = argparse.ArgumentParser()
    for name, value in (
        ("size", 96),
        ("samples", 512),
        ("scenes", 3),
        ("first", 1000),
        ("bounces", 4),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    for name in ("directions", "subsamples"):
        parser.add_argument(f"--{name}", type=int)
    options = parser.parse_args(arguments)
    config = SceneConfig(size=options.size, bounces=options.bounces)
    if options.directions:
        config = dataclasses.replace(config, directions=options.directions)
    if options.subsamples:
        config = dataclasses.replace(config, samples=options.subsamples)
    print(config)
    total: dict[str, list[float]] = {name: [] for name in CLASSES}
    for index in range(options.first, options.first + options.scenes):
        started = time.perf_counter()
        drawn = draw_scene(20, index, config)
        seconds = time.perf_counter() - started
        scene = comparable(drawn)
        ours = render_scene(scene, config)
        patches = len(scene.materials["diffuse"].albedo())
        shapes = mitsuba_shapes(scene, "diffuse")
        normals = render_with_mitsuba(shapes, config.size, 256, None)[ours.mask]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip((normals * ours.normals).sum(axis=1), -1, 1)))
        print(
            f"{index} {scene.shape}: {patches} patches, {len(scene.mesh.faces)} faces,"
            f" {len(ours.normals)} pixels; drawn in {seconds:.1f} s; normals {angle.mean():.3f}"
            " deg"
        )
        for name in CLASSES:
            shapes = mitsuba_shapes(scene, name)
            rows = []
            for column, light in enumerate(lights()):
                halves = [
                    render_with_mitsuba(
                        shapes,
                        config.size,
                        options.samples // 2,
                        light,
                        depth=options.bounces + 2,
                        seed=seed,
                    )[ours.mask]
                    for seed in (0, 1)
                ]
                truth = (halves[0] + halves[1]) / 2
                # The halves differ by twice the noise of their mean.
                noise = np.abs(halves[0] - halves[1]).mean() / 2 / truth.mean()
                mine = ours.observations[name][:, column]
                rows.append(
                    (
                        np.abs(mine - truth).mean() / truth.mean(),
                        mine.mean() / truth.mean() - 1,
                        noise,
                    )
                )
            errors = np.array(rows)
            total[name].append(float(errors[:, 0].mean()))
            by_light = " ".join(f"{100 * error:5.1f}" for error in errors[:, 0])
            print(
                f"  {name:9} {100 * errors[:, 0].mean():5.2f} % (by light {by_light}), mean"
                f" {100 * errors[:, 1].mean():+.2f} %, Mitsuba's noise"
                f" {100 * errors[:, 2].mean():.2f} %",
                flush=True,
            )
    print("  ".join(f"{name} {100 * np.mean(errors):.2f} %" for name, errors in total.items()))


if __name__ == "__main__":
    torch.set_num_threads(2)
    main()
