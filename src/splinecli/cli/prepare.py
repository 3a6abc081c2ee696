"""`splinecli prepare`: captures with ground truth, CyclesPS trees and rendered scenes -> a pixel set."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import JsonOption, QuietOption, SeedOption
from splinecli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splinecli.pixel_sets.preparation import ScenePlan
    from splinecli.pixel_sets.store import PixelSet

CONTACT_SHEET = "contact_sheet.png"


def prepare(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="SET", help="Folder of the pixel set.")],
    sources: Annotated[
        list[Path] | None,
        typer.Argument(metavar="SOURCE", help="Captures with ground truth, folders of them, CyclesPS trees."),
    ] = None,
    scenes: Annotated[int, typer.Option(metavar="N", min=0, help="Render N scenes.")] = 0,
    mesh: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Render a scene of this mesh (PLY, OBJ, STL, ...); repeatable."),
    ] = None,
    size: Annotated[
        int | None, typer.Option(metavar="PIXELS", min=8, help="Side of the rendered images. [default: 128]")
    ] = None,
    lights: Annotated[
        int | None, typer.Option(metavar="F", min=16, help="Lights of a rendered scene. [default: 500]")
    ] = None,
    measured: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Measured materials (.npz) to use in the scenes too.")
    ] = None,
    measured_share: Annotated[
        float, typer.Option(metavar="SHARE", min=0, max=1, help="Share of the materials that are measured.")
    ] = 0.5,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Make a pixel set, the training data of `splinecli train SET`.

    Every pixel comes with its true normal and what it shows under all lights. Rendering needs the extra
    packages of 'splinecli[render]'. Writes SET/manifest.json, a folder for each entry, and
    SET/contact_sheet.png to look at. An interrupted command, given again, goes on, and what is new joins a set that
    is there. A capture that cannot be read is named and passed over; the exit code is then 3.
    """
    from splinecli.capture import find_captures
    from splinecli.files import check_writable, held_folder, write_bytes
    from splinecli.pictures.contact_sheet import contact_sheet
    from splinecli.pictures.png import encode_png
    from splinecli.pixel_sets.preparation import add_capture, add_scene, name_captures
    from splinecli.pixel_sets.store import PixelSetWriter

    if not sources and not scenes and not mesh:
        raise UsageError("nothing to prepare", hint="Name a SOURCE, or ask for --scenes N or --mesh FILE")
    check_writable(output)
    # Wrong ones are refused before anything is made.
    folders = [folder for source in sources or [] for folder in find_captures(source)]
    plan = _plan(scenes, mesh or [], seed, size, lights, measured, measured_share)
    talk = Messages(quiet=quiet)
    skipped: list[dict[str, str]] = []
    with held_folder(output):
        writer = PixelSetWriter(output)
        captures = name_captures(folders, writer)
        with talk.progress("preparing", len(captures) + len(plan.names)) as advance:
            for name, folder in captures.items():
                try:
                    add_capture(writer, name, folder)
                    talk.say(writer.describe(name))
                except InputError as error:
                    skipped.append({"source": str(folder), "reason": str(error)})
                    print(f"splinecli: {error}", file=sys.stderr)
                advance(1)
            for position in range(len(plan.names)):
                done = _Share(advance)
                for name in add_scene(writer, plan, position, done.reach):
                    talk.say(writer.describe(name))
                done.reach(1.0)
        if not len(writer):
            return InputError.exit_code
        pixel_set = writer.finish()
        write_bytes(output / CONTACT_SHEET, encode_png(contact_sheet(pixel_set)))
    summary = {**_summary(pixel_set), "skipped": skipped}
    if as_json:
        print(json.dumps(summary, indent=2))
    elif not quiet:
        print(
            f"{output}: {summary['entries']} entries of {summary['scenes']} scenes, {summary['n_pixels']} pixels,"
            f" {summary['bytes'] / 1e6:.0f} MB; look at {output / CONTACT_SHEET}"
        )
    return InputError.exit_code if skipped else 0


class _Share:
    """Turns the share of a scene that is done into steps of the bar."""

    def __init__(self, advance: Callable[[float], None]) -> None:
        self.advance, self.done = advance, 0.0

    def reach(self, share: float) -> None:
        self.advance(share - self.done)
        self.done = share


def _plan(
    scenes: int,
    meshes: list[Path],
    seed: int,
    size: int | None,
    lights: int | None,
    measured: Path | None,
    measured_share: float,
) -> ScenePlan:
    from splinecli.pixel_sets.preparation import ScenePlan
    from splinecli.synthesis.meshes import read_mesh
    from splinecli.synthesis.scenes import SceneConfig

    for path in meshes:
        read_mesh(path)  # a bad one is refused before anything is rendered
    config = SceneConfig()
    config = replace(
        config,
        size=size or config.size,
        lights=lights or config.lights,
        measured_share=measured_share if measured else 0.0,
    )
    plan = ScenePlan(config, seed, scenes, tuple(meshes), measured)
    _ = plan.library  # the same of a bad file
    return plan


def _summary(pixel_set: PixelSet) -> dict[str, Any]:
    from splinecli.pixel_sets.store import MANIFEST

    return {
        "set": str(pixel_set.folder),
        "entries": len(pixel_set.entries),
        "scenes": len({entry.scene for entry in pixel_set.entries}),
        "n_pixels": sum(entry.n_pixels for entry in pixel_set.entries),
        "bytes": sum(path.stat().st_size for path in pixel_set.folder.rglob("*.npy")),
        "manifest": str(pixel_set.folder / MANIFEST),
        "contact_sheet": str(pixel_set.folder / CONTACT_SHEET),
    }
