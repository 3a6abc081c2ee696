"""What `prepare` does: captures with ground truth and rendered scenes become the entries of a pixel set."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture import capture_name, open_capture
from splinecli.capture.stamp import digest, stamp_capture
from splinecli.errors import InputError
from splinecli.files import file_sha256
from splinecli.pixel_sets.store import Pixels, PixelSetWriter
from splinecli.synthesis.measured import MeasuredLibrary
from splinecli.synthesis.measured_files import read_measured
from splinecli.synthesis.meshes import read_mesh
from splinecli.synthesis.scenes import CLASSES, SceneConfig, draw_scene, render_scene

RENDERER = 1
"""To be raised when the same scene comes out otherwise: a set must not mix both without saying so."""

_MESH_INDICES = 1_000_000


def name_captures(folders: Sequence[Path], writer: PixelSetWriter) -> dict[str, Path]:
    """The folders of captures by the name of their entries; one that is there twice counts once.

    A capture keeps the name that it has in the set; a new one gets its own, with a number where that is taken.
    """
    captures: dict[str, Path] = {}
    # A capture's pixels must not be both held back and trained on.
    for resolved, folder in {folder.resolve(): folder for folder in folders}.items():

        def is_taken(name: str, source: str = str(resolved)) -> bool:
            others = name in writer and writer.recipe_of(name).get("source") != source
            return name in captures or others

        captures[_number(capture_name(folder), is_taken)] = folder
    return captures


def _number(name: str, is_taken: Callable[[str], bool]) -> str:
    """The name, with the first number from 2 that makes it free where it is taken."""
    numbered = (f"{name}-{count}" for count in itertools.count(2))
    return next(each for each in itertools.chain([name], numbered) if not is_taken(each))


def add_capture(writer: PixelSetWriter, name: str, folder: Path) -> None:
    """Read a capture and write its pixels with ground truth, unless they are there.

    Of the images in CyclesPS's PRPS every second row and column counts, as in the training of CNN-PS, which
    reads them at half their size.

    Raises:
        InputError: the capture cannot be read, or holds no ground truth.
        OutputError: the entry cannot be written, or is there from other files.
    """
    source = open_capture(folder)
    recipe = {"source": str(folder.resolve()), "files": digest(stamp_capture(source))}
    if writer.holds(name, recipe):
        return
    if source.files.ground_truth is None:
        raise InputError("the capture has no ground truth, which training needs", path=folder)
    capture = source.read(as_stored=True)
    assert capture.ground_truth is not None
    truth = capture.ground_truth[capture.mask]
    used = truth.any(axis=1)
    holder = source.files.folder.absolute()
    is_cyclesps = bool(source.files.boundaries)
    step = 2 if is_cyclesps and holder.parent.name == "PRPS" else 1
    rows, columns = np.nonzero(capture.mask)
    used &= (rows % step == 0) & (columns % step == 0)
    if not used.any():
        raise InputError("no pixel of the mask has a ground-truth normal", path=folder)
    mask = np.zeros_like(capture.mask)
    mask[capture.mask] = used
    pixels = Pixels(
        observations=capture.observations[used],
        normals=truth[used].astype(np.float32),
        light_directions=capture.light_directions.astype(np.float32),
        mask=mask[::step, ::step],
    )
    # An object's kinds of material share its shape.
    writer.add(name, holder.name if is_cyclesps else name, str(folder), recipe, pixels)


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """Scenes to be rendered: those of the user's meshes, and `count` procedural ones."""

    config: SceneConfig
    seed: int
    count: int
    meshes: tuple[Path, ...] = ()
    measured_materials: Path | None = None

    @cached_property
    def library(self) -> MeasuredLibrary | None:
        """The measured materials. Raises InputError."""
        return None if self.measured_materials is None else read_measured(self.measured_materials)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The scenes' names: of the meshes after their files, numbered where two are called the same."""
        names: list[str] = []
        for path in self.meshes:
            names.append(_number(path.stem, names.__contains__))
        return (*names, *(f"scene{index:04}" for index in range(self.count)))

    @cached_property
    def _materials_sha256(self) -> str | None:
        return None if self.measured_materials is None else file_sha256(self.measured_materials)

    def recipe(self, position: int) -> dict[str, Any]:
        """What decides the content of a scene."""
        return {
            "renderer": RENDERER,
            **asdict(self.config),
            "seed": self.seed,
            "mesh": file_sha256(self.meshes[position]) if position < len(self.meshes) else None,
            "measured_materials": self._materials_sha256,
        }


def add_scene(
    writer: PixelSetWriter,
    plan: ScenePlan,
    position: int,
    progress: Callable[[float], None] | None = None,
) -> list[str]:
    """Render a scene of the plan in all its materials, unless it is there; returns its entries' names.

    Raises:
        InputError: its mesh, or the file of measured materials, cannot be used, or the camera sees nothing of it.
        OutputError: an entry cannot be written, or is there in another way.
        UsageError: the packages of the extra `render` are missing.
    """
    scene_name, recipe = plan.names[position], plan.recipe(position)
    names = {kind: f"{scene_name}-{kind}" for kind in CLASSES}
    if all(writer.holds(name, recipe) for name in names.values()):
        return list(names.values())
    given = position < len(plan.meshes)
    mesh = read_mesh(plan.meshes[position]) if given else None
    # Meshes have random numbers of their own: scenes stay what they are when a mesh joins them.
    index = _MESH_INDICES + position if given else position - len(plan.meshes)
    draw_measured = plan.library.draw if plan.library else None
    scene = draw_scene(plan.seed, index, plan.config, mesh, draw_measured=draw_measured)
    rendered = render_scene(scene, plan.config, progress)
    if not rendered.mask.any():
        raise InputError(
            "the camera sees nothing of it",
            path=plan.meshes[position] if given else scene_name,
            hint="The camera looks along -z at the outer sides of faces, anticlockwise seen from outside",
        )
    for kind, name in names.items():
        pixels = Pixels(
            # Half precision, 0.05 %, is finer than the render's own noise.
            observations=rendered.observations[kind].astype(np.float16),
            normals=rendered.normals.astype(np.float32),
            light_directions=rendered.light_directions.astype(np.float32),
            mask=rendered.mask,
        )
        writer.add(name, scene_name, f"rendered: {rendered.shape}", recipe, pixels)
    return list(names.values())
