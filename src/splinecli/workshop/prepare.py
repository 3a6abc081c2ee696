"""Build a pixel set from captures with ground truth and from rendered scenes."""

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from splinecli.capture import find_captures
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.pictures.maps import encode_png
from splinecli.pipeline.distribution import LostError, WorkItem, distributor
from splinecli.pipeline.infer_options import ClusterOptions
from splinecli.records.output_files import CONTACT_SHEET
from splinecli.system.files import UNFINISHED, as_splinecli_error, check_writable, write_bytes
from splinecli.system.progress import SILENT, Advance, Observer
from splinecli.system.publishing import held_folder
from splinecli.workshop.contact_sheet import contact_sheet
from splinecli.workshop.options import PrepareOptions
from splinecli.workshop.pixel_sets import entries
from splinecli.workshop.pixel_sets.entries import CaptureChangedError, ScenePlan
from splinecli.workshop.pixel_sets.store import MANIFEST, PixelSet, PixelSetWriter
from splinecli.workshop.synthesis.scenes import SceneConfig


def prepare_pixel_set(options: PrepareOptions, observer: Observer = SILENT) -> dict[str, Any]:
    """Write a pixel set, or add to it, and return its summary, which `prepare --json` prints.

    A capture that cannot be used is left out. Its error is passed to the observer, and `skipped` in
    the summary contains the reason and an exit code. Any other error stops the work, and calling
    the function again resumes it: InputError for a mesh, OutputError also if the set contains a
    scene with other settings, or UsageError if there is nothing to prepare.
    """
    output, usual = options.output, SceneConfig()
    size, n_lights = options.size or usual.size, options.n_lights or usual.lights
    plan = ScenePlan(
        replace(usual, size=size, lights=n_lights),
        options.seed,
        options.scenes,
        options.meshes,
        options.views,
        options.reliefs,
        options.groups,
    )
    captures = [folder for source in options.sources for folder in find_captures(source)]
    if not captures and not plan.names:
        raise UsageError(
            "nothing to prepare", hint="Name a SOURCE, or add --scenes N, --groups N or --mesh FILE"
        )
    check_writable(output)
    plan.check_inputs()
    cluster = ClusterOptions(workers=options.processes.workers).on_cores(len(plan.names))
    with held_folder(output, observer.warn):
        writer = PixelSetWriter(output)
        plan.check_set(writer)
        named = entries.name_captures(captures, writer)
        with observer.progress("preparing", len(named) + len(plan.names)) as advance:
            skipped: list[dict[str, Any]] = []
            for name, folder in named.items():
                try:
                    entries.add_capture(
                        writer,
                        name,
                        folder,
                        update=options.update,
                        as_stored=options.as_stored,
                        white_level=options.white_level,
                    )
                    observer.say(writer.describe(name))
                except (InputError, CaptureChangedError, OSError) as refused:
                    error: SplinecliError = (
                        as_splinecli_error(refused, folder)
                        if isinstance(refused, OSError)
                        else refused
                    )
                    observer.error(str(error))
                    skipped.append(
                        {"source": str(folder), "reason": str(error), "exit_code": error.exit_code}
                    )
                advance(1)
            _render_scenes(writer, plan, cluster, observer, advance)
        pixel_set = PixelSet(output, ())
        if len(writer):
            # Written before the set is marked as finished, so that a finished set always has its
            # own overview.
            write_bytes(output / CONTACT_SHEET, encode_png(contact_sheet(writer.pixel_set)))
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


def _render_scenes(
    writer: PixelSetWriter,
    plan: ScenePlan,
    cluster: ClusterOptions | None,
    observer: Observer,
    advance: Advance,
) -> None:
    """Render the scenes missing from the set, and add them in the order of the plan.

    They are rendered by this process or by workers. Raises any error of a worker or the set, and
    LostError if the workers of a scene were lost, after finishing all other scenes.
    """
    reached = 0.0

    def reach(share: float) -> None:
        nonlocal reached
        advance(share - reached)
        reached = share

    add = _add_here if cluster is None else partial(_add_from_workers, cluster, observer)
    with closing(add(writer, plan, reach)) as positions:
        for position in positions:
            for name in plan.entry_names(position).values():
                observer.say(writer.describe(name))
            reach(1.0)
            reached = 0.0


def _missing(writer: PixelSetWriter, plan: ScenePlan) -> list[int]:
    """Return the positions of the plan's scenes that are not in the set, or not complete."""
    names = map(plan.entry_names, range(len(plan.names)))
    return [n for n, each in enumerate(names) if not all(name in writer for name in each.values())]


def _add_here(
    writer: PixelSetWriter, plan: ScenePlan, reach: Callable[[float], None]
) -> Generator[int, None, None]:
    """Add the missing scenes to the set, and yield the position of each scene of the plan."""
    missing = _missing(writer, plan)
    for position in range(len(plan.names)):
        if position in missing:
            plan.add(writer, position, *plan.render(position, reach))
        yield position


def _add_from_workers(
    cluster: ClusterOptions, observer: Observer, writer: PixelSetWriter, plan: ScenePlan, _: object
) -> Generator[int, None, None]:
    """Do the same as _add_here with scenes that workers render. The order is that of the plan."""
    missing = _missing(writer, plan)
    # Results by position: the shape that was rendered, an error, or None for a scene in the set.
    rendered: dict[int, str | LostError | None] = {}
    position, folder = 0, writer.folder
    # A worker writes a scene to a hidden file of the set. Only this process adds it to the set.
    render = partial(_render, plan, folder)
    try:
        with distributor(render, folder, cluster, observer) as workers:
            in_set = ((n, None) for n in range(len(plan.names)) if n not in missing)
            items = (WorkItem((n,), plan.names[n]) for n in missing)
            ended = ((item.args[0], shape) for item, shape in workers.run(items))
            for number, result in chain(in_set, ended):
                rendered[number] = result
                while position in rendered:
                    shape = rendered[position]
                    if isinstance(shape, str):
                        path = _path(folder, position)
                        plan.add(writer, position, shape, entries.load_rendered(path))
                        path.unlink()
                    if not isinstance(shape, LostError):
                        yield position
                    position += 1
    finally:
        for number in missing:
            _path(folder, number).unlink(missing_ok=True)
    for result in rendered.values():
        if isinstance(result, LostError):
            raise result


def _path(folder: Path, position: int) -> Path:
    return folder / f".scene{position}{UNFINISHED}"


def _render(plan: ScenePlan, folder: Path, position: int) -> str:
    """Render a scene on a worker, write it to its hidden file, and return its shape."""
    plan.check_inputs()
    shape, pixels = plan.render(position)
    entries.save_rendered(pixels, _path(folder, position))
    return shape
