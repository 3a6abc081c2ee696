"""Entries of pixel sets, created from captures with ground truth and from rendered scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture import CaptureOptions, capture_name, open_capture
from splinecli.capture.files import digest
from splinecli.capture.record import name_reading
from splinecli.errors import InputError, OutputError
from splinecli.recipe import RecipeOptions, prepare_capture
from splinecli.system.files import file_sha256, free_name, replacing
from splinecli.system.machine import import_extra
from splinecli.workshop.pixel_sets.store import ARRAYS, Pixels, PixelSetWriter
from splinecli.workshop.synthesis.groups import draw_group
from splinecli.workshop.synthesis.meshes import read_mesh
from splinecli.workshop.synthesis.scenes import MATERIALS, SceneConfig, draw_scene, render_scene
from splinecli.workshop.synthesis.shapes import draw_view, read_relief


class CaptureChangedError(OutputError):
    """A capture has changed since its entry was created."""


def name_captures(folders: Sequence[Path], writer: PixelSetWriter) -> dict[str, Path]:
    """Return the folders of the captures by the names of their entries.

    A capture that is already in the set keeps its name. A new capture is named after its folder,
    with a number if another capture has that name. Duplicate folders are used only once, because
    the same pixels must not be used for both training and validation.
    """
    captures: dict[str, Path] = {}
    for resolved, folder in {folder.resolve(): folder for folder in folders}.items():

        def is_taken(name: str, source: str = str(resolved)) -> bool:
            by_another = name in writer and writer.recipe_of(name).get("source") != source
            return name in captures or by_another

        captures[free_name(capture_name(folder), is_taken)] = folder
    return captures


def add_capture(
    writer: PixelSetWriter,
    name: str,
    folder: Path,
    *,
    as_stored: bool = False,
    white_level: float | None = None,
    update: bool = False,
) -> None:
    """Read a capture and write its pixels with ground truth, unless the set already contains them.

    For the PRPS images of CyclesPS, only every second row and column is used, because CNN-PS is
    trained on them at half resolution. By default, saturated observations (from `white_level`, if
    it is given) are restored and unknown light intensities are estimated, as in `infer`; with
    `as_stored`, the values are unchanged. `update` replaces an entry whose capture has changed.

    Raises InputError if the capture cannot be read or has no ground truth; CaptureChangedError if
    it has changed since its entry was created, and `update` is not set; OutputError if the entry
    cannot be written.
    """
    source = open_capture(folder, CaptureOptions(white_level=white_level))
    recipe: dict[str, Any] = {
        "source": str(folder.resolve()),
        "reading": name_reading(as_stored=as_stored),
        "white_level": white_level,
        # The stamp depends on the white level too, so it is compared last.
        "files": digest(source.stamp),
    }
    if source.lamps is not None and source.lamps.used:
        raise InputError(
            "the capture has near lamps, and training needs distant lights",
            path=folder,
            hint="Leave it out, or render or photograph it under distant lights",
        )
    if name in writer:
        difference = writer.difference(name, recipe)
        if difference is None:
            return
        if not update:
            problem = f"its entry {name} was made with {difference}"
            if difference.startswith("files ="):
                problem = f"its files changed since the entry {name} was made"
            hint = "Add --update to read it again, or choose another -o"
            raise CaptureChangedError(problem, path=folder, hint=hint)
    if source.files.ground_truth is None:
        raise InputError("the capture has no ground truth, which training needs", path=folder)
    capture = prepare_capture(source, options=RecipeOptions(as_stored=as_stored))
    assert capture.ground_truth is not None
    normals = capture.ground_truth[capture.mask]
    # The PRPS images of CyclesPS are used at half resolution.
    step = (
        2 if source.files.boundaries and source.files.folder.absolute().parent.name == "PRPS" else 1
    )
    rows, columns = np.nonzero(capture.mask)
    used = normals.any(axis=1) & (rows % step == 0) & (columns % step == 0)
    if not used.any():
        raise InputError("no pixel in the mask has a ground-truth normal", path=folder)
    mask = np.zeros_like(capture.mask)
    mask[capture.mask] = used
    directions = capture.light_directions.astype(np.float32)
    pixels = Pixels(
        capture.observations[used],
        normals[used].astype(np.float32),
        directions,
        mask[::step, ::step],
    )
    # All materials of a CyclesPS object have the same shape.
    scene = source.files.folder.absolute().name if source.files.boundaries else name
    writer.add(name, scene, str(folder), recipe, pixels)


# Version of the renderer. Increase it when the result changes, because a set must not mix versions.
RENDERER = 6

# of a view or a group. An open surface, such as a terrain, is invisible from behind.
_MOST_DRAWS = 20


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """The scenes to render: the views of each mesh file, then `count` random scenes, then `groups`.

    With groups, which include the meshes, meshes are only rendered alone if `views` is above 0.
    """

    config: SceneConfig
    seed: int
    count: int
    meshes: tuple[Path, ...] = ()
    views: int = 0  # random views per mesh, see draw_view; 0 for one view along its +z axis
    reliefs: tuple[Path, ...] = ()  # normal maps, for half of the scenes
    groups: int = 0  # number of groups of bodies, see draw_group

    @cached_property
    def _of_mesh(self) -> tuple[tuple[Path, str, int], ...]:
        """The mesh, name and number of each mesh scene. The number does not depend on the number of
        views.

        The name is the file name, with a number if another mesh has the same name.
        """
        taken: list[str] = []
        for path in self.meshes:
            taken.append(free_name(path.stem, taken.__contains__))
        named = [*zip(self.meshes, taken, range(len(taken)), strict=True)]
        if not self.views:
            return () if self.groups else tuple(named)
        views = range(self.views)
        return tuple(
            (path, f"{name}-view{n:03}", mesh + 10_000 * n)
            for n in views
            for path, name, mesh in named
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the scenes."""
        scenes = (
            f"{kind}{n:04}"
            for kind, count in (("scene", self.count), ("group", self.groups))
            for n in range(count)
        )
        return (*(name for _, name, _ in self._of_mesh), *scenes)

    def _config_of(self, position: int) -> SceneConfig:
        if position < len(self._of_mesh) + self.count:
            return self.config
        return replace(self.config, sharp_share=0.5, perspective_share=0.3)

    def entry_names(self, position: int) -> dict[str, str]:
        """Return the names of a scene's entries by material."""
        return {kind: f"{self.names[position]}-{kind}" for kind in MATERIALS}

    def recipe(self, position: int) -> dict[str, Any]:
        """Return the values that determine the content of a scene."""
        meshes = self._of_mesh[position : position + 1]
        shapes = [file_sha256(path) for path, _, _ in meshes]
        # Another mesh may be placed next to it.
        if (meshes and self.views) or position >= len(self._of_mesh) + self.count:
            shapes += [file_sha256(path) for path in self.meshes]
        return {
            "renderer": RENDERER,
            **asdict(self._config_of(position)),
            "seed": self.seed,
            "mesh": shapes or None,
            "views": int(bool(meshes and self.views)),
            "reliefs": [file_sha256(path) for path in self.reliefs],
        }

    def check_inputs(self) -> None:
        """Check the inputs before rendering.

        Raises InputError if a mesh cannot be used, or UsageError if there are scenes to render but
        the packages of the extra `render` are not installed.
        """
        if self.names:
            for package in ("embreex.rtcore_scene", "skimage.measure"):
                import_extra(package, "render")
        for path in self.meshes:
            read_mesh(path)
        for path in self.reliefs:
            read_relief(path)

    def check_set(self, writer: PixelSetWriter) -> None:
        """Raise OutputError if the set contains one of the scenes rendered with other settings."""
        for position in range(len(self.names)):
            recipe = self.recipe(position)
            for name in self.entry_names(position).values():
                difference = writer.difference(name, recipe) if name in writer else None
                if difference is not None:
                    raise OutputError(
                        f"the entry {name} was made with {difference}",
                        path=writer.folder,
                        hint="Choose another -o",
                    )

    def render(
        self, position: int, progress: Callable[[float], None] | None = None
    ) -> tuple[str, dict[str, Pixels]]:
        """Render a scene, and return a description of its shape and the pixels by material.

        `progress` is called with the finished share, 0 to 1. Raises InputError if the mesh cannot
        be used or nothing is visible, and UsageError if the packages of the extra `render` are not
        installed.
        """
        mesh_file = mesh = group = grade = None
        index = position - len(self._of_mesh)
        if index < 0:
            mesh_file, _, number = self._of_mesh[position]
            # of its own random stream, so that a mesh does not change any other scene
            index = 1_000_000 + number
            given = mesh = read_mesh(mesh_file)
            others = tuple(path for path in self.meshes if path != mesh_file)
        elif index >= self.count:
            # In steps of the golden ratio, so that even a small set has all grades
            grade = float(
                (
                    np.random.default_rng(self.seed).random()
                    + (index - self.count) * (np.sqrt(5) - 1) / 2
                )
                % 1
            )
            index += 2_000_000 - self.count
        config, rng = self._config_of(position), np.random.default_rng([self.seed, index, 2])
        for _ in range(_MOST_DRAWS if self.views or grade is not None else 1):
            if grade is not None:
                group, mesh = draw_group(rng, self.meshes, grade)
            elif mesh_file is not None and self.views:
                mesh = draw_view(given, others, rng)
            scene = draw_scene(self.seed, index, config, mesh, self.reliefs)
            rendered = render_scene(scene, config, progress)
            if rendered.mask.any():
                break
        else:
            raise InputError(
                "no face of the mesh is visible to the camera",
                path=mesh_file or self.names[position],
                hint="The camera looks along -z. A face is visible if its corners are"
                " counter-clockwise as seen from the camera",
            )
        normals, lights = rendered.normals.astype(np.float32), scene.lights.astype(np.float32)
        # float16 has a relative precision of 0.05 %, finer than the noise of the rendering.
        observations = {
            kind: values.astype(np.float16) for kind, values in rendered.observations.items()
        }
        return group or scene.shape, {
            kind: Pixels(observations[kind], normals, lights, rendered.mask) for kind in MATERIALS
        }

    def add(
        self, writer: PixelSetWriter, position: int, shape: str, pixels: Mapping[str, Pixels]
    ) -> None:
        """Add the entries of a scene to a set that has passed check_set. Raises OutputError."""
        recipe = self.recipe(position)
        # All views of a mesh have one name, because all are used for training or all for
        # validation.
        scene = (
            self._of_mesh[position][0].stem
            if position < len(self._of_mesh)
            else self.names[position]
        )
        for kind, name in self.entry_names(position).items():
            writer.add(name, scene, f"rendered: {shape}", recipe, pixels[kind])


def save_rendered(pixels: Mapping[str, Pixels], path: Path) -> None:
    """Write the pixels of a scene to a file for load_rendered. Raises OutputError."""
    arrays = {
        f"{kind}.{name}": getattr(pixels[kind], name) for kind in MATERIALS for name in ARRAYS
    }
    with replacing(path) as file:
        np.savez(file, **arrays)


def load_rendered(path: Path) -> dict[str, Pixels]:
    """Return the pixels in a file written by save_rendered. Raises OSError."""
    with np.load(path, allow_pickle=False) as arrays:
        return {
            kind: Pixels(**{name: arrays[f"{kind}.{name}"] for name in ARRAYS})
            for kind in MATERIALS
        }
