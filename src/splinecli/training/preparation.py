"""What `prepare` does: captures with ground truth and rendered scenes become the entries of a pixel set."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture import capture_name, find_captures, open_capture
from splinecli.errors import InputError
from splinecli.synthesis.measured import MeasuredLibrary
from splinecli.synthesis.measured_files import read_measured
from splinecli.synthesis.meshes import read_mesh
from splinecli.synthesis.scenes import CLASSES, SceneConfig, draw_scene, render_scene
from splinecli.training.pixel_sets import Pixels, PixelSetWriter


def list_captures(sources: Sequence[Path]) -> dict[str, Path]:
    """The captures in folders of captures, datasets and CyclesPS trees, by the name of their entries.

    Raises:
        InputError: a source holds no capture.
    """
    captures: dict[str, Path] = {}
    for source in sources:
        for folder in find_captures(source):
            name = plain = capture_name(folder)
            count = 1
            while name in captures:
                count += 1
                name = f"{plain}-{count}"
            captures[name] = folder
    return captures


def add_capture(writer: PixelSetWriter, name: str, folder: Path) -> None:
    """Read a capture and write its pixels with ground truth, unless they are there.

    Of the images in CyclesPS's PRPS every second row and column counts, as in the training of CNN-PS, which
    reads them at half their size.

    Raises:
        InputError: the capture cannot be read, or holds no ground truth.
        OutputError: the entry cannot be written.
    """
    if name in writer:
        return
    source = open_capture(folder)
    capture = source.read()
    if capture.ground_truth is None:
        raise InputError("the capture has no ground truth, which training needs", path=folder)
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
    writer.add(name, holder.name if is_cyclesps else name, str(folder), pixels)


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """Scenes to be rendered: those of the user's meshes first, then procedural ones."""

    config: SceneConfig
    seed: int
    count: int
    meshes: tuple[Path, ...] = ()
    measured_materials: Path | None = None

    def __len__(self) -> int:
        return self.count

    @property
    def recipe(self) -> dict[str, Any]:
        """What decides the content of every scene; more scenes may join a set, so their number is left out."""
        materials = self.measured_materials
        return {
            "scene": asdict(self.config),
            "seed": self.seed,
            "meshes": {path.name: _sha256(path) for path in self.meshes},
            "measured_materials": None if materials is None else _sha256(materials),
        }

    @cached_property
    def library(self) -> MeasuredLibrary | None:
        """The measured materials. Raises InputError."""
        return None if self.measured_materials is None else read_measured(self.measured_materials)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def add_scene(writer: PixelSetWriter, plan: ScenePlan, index: int) -> list[str]:
    """Render a scene of the plan in all its materials, unless it is there; returns its entries' names.

    Raises:
        InputError: its mesh, or the file of measured materials, cannot be used.
        OutputError: an entry cannot be written.
        UsageError: the packages of the extra `render` are missing.
    """
    scene_name = f"scene{index:04}"
    names = {kind: f"{scene_name}-{kind}" for kind in CLASSES}
    if not all(name in writer for name in names.values()):
        mesh = read_mesh(plan.meshes[index]) if index < len(plan.meshes) else None
        draw_measured = plan.library.draw if plan.library else None
        scene = draw_scene(plan.seed, index, plan.config, mesh, draw_measured=draw_measured)
        rendered = render_scene(scene, plan.config)
        for kind, name in names.items():
            pixels = Pixels(
                # Half precision, 0.05 %, is finer than the render's own noise.
                observations=rendered.observations[kind].astype(np.float16),
                normals=rendered.normals.astype(np.float32),
                light_directions=rendered.light_directions.astype(np.float32),
                mask=rendered.mask,
            )
            writer.add(name, scene_name, f"rendered: {rendered.shape}", pixels)
    return list(names.values())
