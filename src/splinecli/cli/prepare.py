"""`splinecli prepare`: make a pixel set from captures with ground truth, CyclesPS trees and rendered scenes."""

from dataclasses import replace
from pathlib import Path

from typer import Argument, Option

from splinecli.capture import find_captures
from splinecli.cli import shared
from splinecli.cli.console import Messages, print_report


def prepare(
    output: Path = Option(..., "--output", "-o", metavar="SET", help="Folder of the pixel set."),
    sources: list[Path] | None = Argument(
        None, metavar="SOURCE", help="Captures with ground truth, folders of them, CyclesPS trees."
    ),
    as_stored: bool = shared.AS_STORED,
    white_level: float | None = shared.WHITE_LEVEL,
    update: bool = shared.UPDATE,
    scenes: int = Option(0, metavar="N", min=0, help="Render N random scenes."),
    mesh: list[Path] | None = Option(
        None, metavar="FILE", help="Render a scene of this mesh (PLY, OBJ, STL, OFF). May be repeated."
    ),
    views: int = Option(
        0, metavar="N", min=0, help="Render each mesh N times, from random views. By default once, along its +z axis."
    ),
    relief: list[Path] | None = Option(
        None, metavar="FILE", help="Put this tileable normal map on half of the scenes. May be repeated."
    ),
    size: int | None = Option(
        None, metavar="PIXELS", min=8, help="Width and height of the rendered images. [default: 128]"
    ),
    n_lights: int | None = Option(
        None, metavar="N", min=16, help="Number of lights of a rendered scene. [default: 100]"
    ),
    seed: int = shared.SEED,
    workers: str = Option(
        "1",
        metavar="N|auto",
        help="Render N scenes side by side, in processes of this machine (needs the extra 'cluster'). auto is the"
        " number of cores.",
    ),
    as_json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
) -> int:
    """Make a pixel set, the training data of `splinecli train SET`.

    A pixel set has the true normal of each pixel and its observations under all lights. Writes SET/manifest.json, a
    folder for each capture and scene, and the overview SET/contact_sheet.png. The same command continues after an
    interruption, and adds to a set that exists. Captures that cannot be read are reported and skipped. Rendering needs
    the extra packages of 'splinecli[render]'.
    """
    from splinecli.pipeline.batch import worst_exit_code
    from splinecli.pipeline.prepare import prepare_pixel_set
    from splinecli.pixel_sets.entries import ScenePlan
    from splinecli.synthesis.scenes import SceneConfig

    config = SceneConfig()
    config = replace(config, size=size or config.size, lights=n_lights or config.lights)
    summary = prepare_pixel_set(
        output,
        [folder for source in sources or [] for folder in find_captures(source)],
        ScenePlan(config, seed, scenes, tuple(mesh or ()), views, tuple(relief or ())),
        as_stored=as_stored,
        white_level=white_level,
        update=update,
        cluster=shared.parse_cluster(workers),
        observer=Messages(quiet=quiet),
    )
    in_words = (
        f"{summary['set']}: {summary['entries']} entries of {summary['scenes']} scenes, {summary['n_pixels']} pixels,"
        f" {summary['bytes'] / 1e6:.0f} MB; overview in {summary['contact_sheet']}"
    )
    print_report(summary, *([in_words] if summary["entries"] else []), as_json=as_json, quiet=quiet)
    return worst_exit_code(capture["exit_code"] for capture in summary["skipped"])
