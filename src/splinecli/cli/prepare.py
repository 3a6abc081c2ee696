"""`splinecli prepare`: make a pixel set from captures with ground truth, CyclesPS trees and rendered scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import distribution, inputs, outputs, training
from splinecli.cli.options.values import parse_cluster
from splinecli.errors import UsageError

if TYPE_CHECKING:
    from splinecli.pixel_sets.rendered import ScenePlan


def prepare(
    output: Path = outputs.PIXEL_SET,
    sources: list[Path] | None = training.SOURCES,
    as_stored: bool = inputs.AS_STORED,
    white_level: float | None = inputs.WHITE_LEVEL,
    update: bool = outputs.UPDATE,
    scenes: int = training.SCENES,
    mesh: list[Path] | None = training.MESHES,
    size: int | None = training.IMAGE_SIZE,
    n_lights: int | None = training.SCENE_LIGHTS,
    seed: int = inputs.SEED,
    workers: str = distribution.SCENE_WORKERS,
    as_json: bool = outputs.JSON,
    quiet: bool = outputs.QUIET,
) -> int:
    """Make a pixel set, the training data of `splinecli train SET`.

    A pixel set has the true normal of each pixel and its observations under all lights. Writes SET/manifest.json, a
    folder for each capture and scene, and the overview SET/contact_sheet.png. The same command continues after an
    interruption, and adds to a set that exists. Captures that cannot be read are reported and skipped. Rendering needs
    the extra packages of 'splinecli[render]'.
    """
    if not sources and not scenes and not mesh:
        raise UsageError("nothing to prepare", hint="Name a SOURCE, or add --scenes N or --mesh FILE")

    from splinecli.capture import find_captures
    from splinecli.pipeline.batch import worst_exit_code
    from splinecli.pipeline.prepare import PrepareOptions, prepare_pixel_set

    options = PrepareOptions(
        output=output,
        captures=tuple(folder for source in sources or [] for folder in find_captures(source)),
        scenes=_plan(scenes, mesh or [], seed, size, n_lights),
        as_stored=as_stored,
        white_level=white_level,
        update=update,
        cluster=parse_cluster(workers),
    )
    summary = prepare_pixel_set(options, Messages(quiet=quiet))
    print_report(summary, *_in_words(summary), as_json=as_json, quiet=quiet)
    return worst_exit_code(capture["exit_code"] for capture in summary["skipped"])


def _plan(scenes: int, meshes: list[Path], seed: int, size: int | None, n_lights: int | None) -> ScenePlan:
    from splinecli.pixel_sets.rendered import ScenePlan
    from splinecli.synthesis.scenes import SceneConfig

    config = SceneConfig()
    config = replace(config, size=size or config.size, lights=n_lights or config.lights)
    return ScenePlan(config, seed, scenes, tuple(meshes))


def _in_words(summary: dict[str, Any]) -> list[str]:
    """Return the summary as a line; no line for an empty set."""
    if not summary["entries"]:
        return []
    return [
        f"{summary['set']}: {summary['entries']} entries of {summary['scenes']} scenes, {summary['n_pixels']} pixels,"
        f" {summary['bytes'] / 1e6:.0f} MB; overview in {summary['contact_sheet']}"
    ]
