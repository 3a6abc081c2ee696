"""The scenes of `prepare` on several processes: one item a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from splinecli.pipeline.connection import ClusterOptions
from splinecli.pipeline.distribution import Item, LostError, distributor
from splinecli.pipeline.observer import Observer
from splinecli.pixel_sets.rendered import (
    ScenePlan,
    add_rendered,
    has_scene,
    load_rendered,
    render_planned,
    save_rendered,
)
from splinecli.pixel_sets.writer import PixelSetWriter
from splinecli.system.files import UNFINISHED


def render_on_workers(
    writer: PixelSetWriter,
    plan: ScenePlan,
    cluster: ClusterOptions,
    observer: Observer,
    on_scene: Callable[[int], object],
) -> None:
    """Render the scenes that the set does not have, and add them in the order of the plan, as one process does.

    A worker writes a scene to a hidden file of the set. This process alone adds it to the set.

    Args:
        writer, plan: see add_scene.
        cluster: where the scenes are rendered.
        observer: receives messages.
        on_scene: called with the number of each scene that the set has then.

    Raises:
        LostError: the workers of a scene were lost. The other scenes are in the set.
        SplinecliError: what add_scene or Distributor.run raises.
    """
    missing = [position for position in range(len(plan.names)) if not has_scene(writer, plan, position)]
    plan_to_send = replace(plan)  # a copy without what the plan has read from files
    rendered: dict[int, str | LostError] = {}
    position = 0

    def add_those_in_order() -> None:
        nonlocal position
        while position < len(plan.names) and (position in rendered or position not in missing):
            shape = rendered.get(position)
            if isinstance(shape, str):
                path = _path(writer.folder, position)
                add_rendered(writer, plan, position, shape, load_rendered(path))
                path.unlink()
            if not isinstance(shape, LostError):
                on_scene(position)
            position += 1

    try:
        with distributor(partial(_render, plan_to_send, writer.folder), writer.folder, cluster, observer) as workers:
            add_those_in_order()
            for item, result in workers.run(Item((number,), plan.names[number]) for number in missing):
                rendered[item.args[0]] = result
                add_those_in_order()
    finally:
        for number in missing:
            _path(writer.folder, number).unlink(missing_ok=True)
    for result in rendered.values():
        if isinstance(result, LostError):
            raise result


def _path(folder: Path, position: int) -> Path:
    return folder / f".scene{position}{UNFINISHED}"


def _render(plan: ScenePlan, folder: Path, position: int) -> str:
    """Render a scene on a worker, write it to its hidden file, and return what was rendered."""
    plan.check_inputs()
    shape, pixels = render_planned(plan, position)
    save_rendered(pixels, _path(folder, position))
    return shape
