"""Rendered scenes as entries of a pixel set."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.errors import InputError, OutputError
from splinecli.pixel_sets.store import ARRAYS, Pixels
from splinecli.pixel_sets.writer import PixelSetWriter
from splinecli.synthesis.meshes import read_mesh
from splinecli.synthesis.principled import CLASSES
from splinecli.synthesis.scenes import SceneConfig, draw_scene, render_scene
from splinecli.system.extras import import_extra
from splinecli.system.files import file_sha256, free_name, replacing

RENDERER = 3  # Version of the renderer. Raise it when a scene comes out differently, because one set must not mix both.

# Meshes have random numbers of their own, so that a mesh changes no other scene.
_FIRST_MESH_INDEX = 1_000_000


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """The scenes to render: first one of each mesh file, then `count` random ones."""

    config: SceneConfig
    seed: int
    count: int
    meshes: tuple[Path, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the scenes. A mesh gives its file name, with a number if another mesh has it."""
        names: list[str] = []
        for path in self.meshes:
            names.append(free_name(path.stem, names.__contains__))
        return (*names, *(f"scene{index:04}" for index in range(self.count)))

    def entry_names(self, position: int) -> dict[str, str]:
        """Return the names of a scene's entries by class of material."""
        return {kind: f"{self.names[position]}-{kind}" for kind in CLASSES}

    def recipe(self, position: int) -> dict[str, Any]:
        """Return the values that decide the content of a scene."""
        return {
            "renderer": RENDERER,
            **asdict(self.config),
            "seed": self.seed,
            "mesh": file_sha256(self.meshes[position]) if position < len(self.meshes) else None,
            "measured_share": 0.0,  # earlier versions had a choice
        }

    def check_inputs(self) -> None:
        """Check what rendering needs, before anything is rendered.

        Raises:
            InputError: a mesh cannot be used.
            UsageError: there are scenes and the packages of the extra `render` are not installed.
        """
        if self.names:
            for package in ("embreex.rtcore_scene", "skimage.measure"):
                import_extra(package, "render")
        for path in self.meshes:
            read_mesh(path)

    def check_set(self, writer: PixelSetWriter) -> None:
        """Raise OutputError if the set has one of the scenes, rendered with other settings."""
        for position in range(len(self.names)):
            recipe = self.recipe(position)
            for name in self.entry_names(position).values():
                difference = writer.difference(name, recipe) if name in writer else None
                if difference is not None:
                    raise OutputError(
                        f"the entry {name} was made with {difference}", path=writer.folder, hint="Choose another -o"
                    )

    def render(self, position: int, progress: Callable[[float], None] | None = None) -> tuple[str, dict[str, Pixels]]:
        """Render a scene; return its shape in words, and the pixels by class of material.

        `progress` is called with the finished share, 0 to 1. Raises InputError if the mesh cannot be used, or the
        camera sees nothing; UsageError if the packages of the extra `render` are not installed.
        """
        mesh_file = self.meshes[position] if position < len(self.meshes) else None
        mesh = None if mesh_file is None else read_mesh(mesh_file)
        index = position - len(self.meshes) if mesh_file is None else _FIRST_MESH_INDEX + position
        scene = draw_scene(self.seed, index, self.config, mesh)
        rendered = render_scene(scene, self.config, progress)
        if not rendered.mask.any():
            raise InputError(
                "the camera sees nothing of the mesh",
                path=mesh_file or self.names[position],
                hint="The camera looks along -z. A face is visible if its corners run anticlockwise towards the camera",
            )
        normals, lights = rendered.normals.astype(np.float32), scene.lights.astype(np.float32)
        # float16 has a relative precision of 0.05 %, finer than the noise of the rendering.
        observations = {kind: values.astype(np.float16) for kind, values in rendered.observations.items()}
        return scene.shape, {kind: Pixels(observations[kind], normals, lights, rendered.mask) for kind in CLASSES}

    def add(self, writer: PixelSetWriter, position: int, shape: str, pixels: Mapping[str, Pixels]) -> None:
        """Add the entries of a scene to a set that has passed check_set. Raises OutputError."""
        recipe = self.recipe(position)
        for kind, name in self.entry_names(position).items():
            writer.add(name, self.names[position], f"rendered: {shape}", recipe, pixels[kind])


def save_rendered(pixels: Mapping[str, Pixels], path: Path) -> None:
    """Write the pixels of a scene to a file, for load_rendered. Raises OutputError."""
    arrays = {f"{kind}.{name}": getattr(pixels[kind], name) for kind in CLASSES for name in ARRAYS}
    with replacing(path) as file:
        np.savez(file, **arrays)


def load_rendered(path: Path) -> dict[str, Pixels]:
    """Return the pixels in a file that save_rendered wrote. Raises OSError."""
    with np.load(path, allow_pickle=False) as arrays:
        return {kind: Pixels(**{name: arrays[f"{kind}.{name}"] for name in ARRAYS}) for kind in CLASSES}
