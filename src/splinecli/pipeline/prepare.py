"""What `prepare` does: captures with ground truth and rendered scenes become a pixel set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.pictures.contact_sheet import contact_sheet
from splinecli.pictures.png import encode_png
from splinecli.pipeline.connection import ClusterOptions
from splinecli.pipeline.observer import SILENT, Advance, Observer
from splinecli.pipeline.prepare_on_workers import render_on_workers
from splinecli.pixel_sets.captures import CaptureChangedError, add_capture, name_captures
from splinecli.pixel_sets.rendered import ScenePlan, add_scene
from splinecli.pixel_sets.store import MANIFEST, PixelSet
from splinecli.pixel_sets.writer import PixelSetWriter
from splinecli.system.files import check_writable, write_bytes
from splinecli.system.publishing import held_folder

CONTACT_SHEET = "contact_sheet.png"


@dataclass(frozen=True, kw_only=True)
class PrepareOptions:
    """What `prepare` puts into a pixel set.

    Args:
        output: the folder of the set, new or an earlier set to add to.
        captures: folders of captures with ground truth.
        scenes: the scenes to render.
        as_stored: use the stored values of captures alone, see add_capture.
        white_level: stored value from which a pixel of a capture counts as saturated; None to find it.
        update: read captures again that changed since they were added.
        cluster: the processes that render scenes; None for this process.

    Raises:
        UsageError: there is nothing to prepare.
    """

    output: Path
    captures: tuple[Path, ...]
    scenes: ScenePlan
    as_stored: bool = False
    white_level: float | None = None
    update: bool = False
    cluster: ClusterOptions | None = None

    def __post_init__(self) -> None:
        if not self.captures and not self.scenes.names:
            raise UsageError("nothing to prepare", hint="Name a SOURCE, or add --scenes N or --mesh FILE")


def prepare_pixel_set(options: PrepareOptions, observer: Observer = SILENT) -> dict[str, Any]:
    """Write a pixel set, or add to it, and return its summary.

    A capture that cannot be used is left out, and the observer receives the error. Every other error ends the work.
    The same call then continues where it stopped.

    Returns:
        The values that `prepare --json` prints. `skipped` lists the captures that were left out, each with the
        reason and an exit code.

    Raises:
        InputError: a mesh cannot be used.
        OutputError: the set cannot be written, or has a scene that was rendered with other settings.
        UsageError: the packages of the extra `render` are not installed.
    """
    check_writable(options.output)
    options.scenes.check_inputs()
    with held_folder(options.output, observer.warn):
        writer = PixelSetWriter(options.output)
        options.scenes.check_set(writer)
        captures = name_captures(options.captures, writer)
        with observer.progress("preparing", len(captures) + len(options.scenes.names)) as advance:
            skipped = _add_captures(writer, captures, options, observer, advance)
            _add_scenes(writer, options, observer, advance)
        pixel_set = PixelSet(options.output, ())
        if len(writer):
            # Before the set counts as finished, so that a finished set has its own overview.
            write_bytes(options.output / CONTACT_SHEET, encode_png(contact_sheet(writer.pixel_set)))
            pixel_set = writer.finish()
    return {
        "set": str(pixel_set.folder),
        "entries": len(pixel_set.entries),
        "scenes": len({entry.scene for entry in pixel_set.entries}),
        "n_pixels": sum(entry.n_pixels for entry in pixel_set.entries),
        "bytes": sum((pixel_set.folder / name).stat().st_size for name in pixel_set.file_names),
        "manifest": str(pixel_set.folder / MANIFEST),
        "contact_sheet": str(pixel_set.folder / CONTACT_SHEET) if pixel_set.entries else None,
        "skipped": skipped,
    }


def _add_captures(
    writer: PixelSetWriter, captures: dict[str, Path], options: PrepareOptions, observer: Observer, advance: Advance
) -> list[dict[str, Any]]:
    """Add the captures and return those that were left out. Raises OutputError if the set cannot be written."""
    skipped: list[dict[str, Any]] = []
    for name, folder in captures.items():
        error: SplinecliError | None = None
        try:
            add_capture(
                writer,
                name,
                folder,
                as_stored=options.as_stored,
                white_level=options.white_level,
                update=options.update,
            )
        except (InputError, CaptureChangedError) as refused:
            error = refused
        except OSError as refused:
            error = InputError(f"cannot be read ({refused.strerror or refused})", path=refused.filename or folder)
        if error is None:
            observer.say(writer.describe(name))
        else:
            observer.error(str(error))
            skipped.append({"source": str(folder), "reason": str(error), "exit_code": error.exit_code})
        advance(1)
    return skipped


def _add_scenes(writer: PixelSetWriter, options: PrepareOptions, observer: Observer, advance: Advance) -> None:
    plan = options.scenes
    cluster = None if options.cluster is None else options.cluster.on_cores(len(plan.names))
    if cluster is not None:

        def show(position: int) -> None:
            for name in plan.entry_names(position).values():
                observer.say(writer.describe(name))
            advance(1)

        render_on_workers(writer, plan, cluster, observer, show)
        return
    for position in range(len(plan.names)):
        done = 0.0

        def reach(share: float) -> None:
            nonlocal done
            advance(share - done)
            done = share

        for name in add_scene(writer, plan, position, reach):
            observer.say(writer.describe(name))
        reach(1.0)
