"""`splinecli prepare`: make a pixel set from captures with ground truth, CyclesPS trees and rendered scenes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import (
    AsStoredOption,
    JsonOption,
    QuietOption,
    SeedOption,
    UpdateOption,
    WhiteLevelOption,
)
from splinecli.errors import UsageError

if TYPE_CHECKING:
    from splinecli.pixel_sets.rendered import ScenePlan


def prepare(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="SET", help="Folder of the pixel set."),
    ],
    sources: Annotated[
        list[Path] | None,
        typer.Argument(metavar="SOURCE", help="Captures with ground truth, folders of them, CyclesPS trees."),
    ] = None,
    as_stored: AsStoredOption = False,
    white_level: WhiteLevelOption = None,
    update: UpdateOption = False,
    scenes: Annotated[int, typer.Option(metavar="N", min=0, help="Render N random scenes.")] = 0,
    mesh: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Render a scene of this mesh (PLY, OBJ, STL, ...). Repeatable."),
    ] = None,
    size: Annotated[
        int | None,
        typer.Option(metavar="PIXELS", min=8, help="Width and height of the rendered images. [default: 128]"),
    ] = None,
    lights: Annotated[
        int | None,
        typer.Option(metavar="F", min=16, help="Number of lights of a rendered scene. [default: 500]"),
    ] = None,
    measured: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also use these measured materials (.npz)."),
    ] = None,
    measured_share: Annotated[
        float,
        typer.Option(metavar="SHARE", min=0, max=1, help="Share of the materials that are measured."),
    ] = 0.5,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Make a pixel set, the training data of `splinecli train SET`.

    A pixel set has the true normal of each pixel and its observations under all lights. Writes SET/manifest.json, a
    folder for each capture and scene, and the overview SET/contact_sheet.png. The same command continues after an
    interruption, and adds to a set that exists. Captures that cannot be read are named and left out. Rendering needs
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
        scenes=_plan(scenes, mesh or [], seed, size, lights, measured, measured_share),
        as_stored=as_stored,
        white_level=white_level,
        update=update,
    )
    summary = prepare_pixel_set(options, Messages(quiet=quiet))
    if as_json:
        print(json.dumps(summary, indent=2))
    elif not quiet and summary["entries"]:
        print(_in_words(summary))
    return worst_exit_code(capture["exit_code"] for capture in summary["skipped"])


def _plan(
    scenes: int,
    meshes: list[Path],
    seed: int,
    size: int | None,
    lights: int | None,
    measured: Path | None,
    measured_share: float,
) -> ScenePlan:
    from splinecli.pixel_sets.rendered import ScenePlan
    from splinecli.synthesis.scenes import SceneConfig

    config = SceneConfig()
    config = replace(
        config,
        size=size or config.size,
        lights=lights or config.lights,
        measured_share=measured_share if measured else 0.0,
    )
    return ScenePlan(config, seed, scenes, tuple(meshes), measured)


def _in_words(summary: dict[str, Any]) -> str:
    return (
        f"{summary['set']}: {summary['entries']} entries of {summary['scenes']} scenes, {summary['n_pixels']} pixels,"
        f" {summary['bytes'] / 1e6:.0f} MB; overview in {summary['contact_sheet']}"
    )
