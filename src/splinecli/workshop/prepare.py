"""Build a pixel set from captures with ground truth and from rendered scenes."""

from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from splinecli.capture import find_captures
from splinecli.errors import InputError, UsageError
from splinecli.pictures.maps import encode_png
from splinecli.pipeline.distribution import Item, LostError, distributor
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

    A capture that cannot be used is left out, and the observer receives the error; `skipped` in the
    summary holds the reason and an exit code. Any other error stops the work, and calling the
    function again resumes it: InputError for a mesh, OutputError, also for a scene with other
    settings in the set, or UsageError if there is nothing to prepare.
    """
    output, config = options.output, SceneConfig()
    config = replace(
        config, size=options.size or config.size, lights=options.n_lights or config.lights
    )
    plan = ScenePlan(
        config, options.seed, options.scenes, options.meshes, options.views, options.reliefs
    )
    captures = [folder for source in options.sources for folder in find_captures(source)]
    if not captures and not plan.names:
        raise UsageError(
            "nothing to prepare", hint="Name a SOURCE, or add --scenes N or --mesh FILE"
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
            how: dict[str, Any] = {
                "as_stored": options.as_stored,
                "white_level": options.white_level,
            }
            for name, folder in named.items():
                try:
                    entries.add_capture(writer, name, folder, update=options.update, **how)
                    observer.say(writer.describe(name))
                except (InputError, CaptureChangedError, OSError) as refused:
                    error = (
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
    """Render the scenes missing from the set, in this process or on workers, and add them in the
    order of the plan.

    Raises LostError if the workers of a scene were lost (after finishing all other scenes), and any
    error from a worker or the set.
    """
    reached = 0.0

    def reach(share: float) -> None:
        nonlocal reached
        advance(share - reached)
        reached = share

    def finish(position: int) -> None:
        nonlocal reached
        for name in plan.entry_names(position).values():
            observer.say(writer.describe(name))
        reach(1.0)
        reached = 0.0

    positions = range(len(plan.names))
    missing = [
        p for p in positions if not all(name in writer for name in plan.entry_names(p).values())
    ]
    if cluster is None:
        for position in positions:
            if position in missing:
                plan.add(writer, position, *plan.render(position, reach))
            finish(position)
        return
    in_set = ((position, None) for position in positions if position not in missing)
    rendered: dict[int, str | LostError | None] = {}
    # A worker writes a scene to a hidden file of the set. Only this process adds it to the set.
    render = partial(_render, plan, writer.folder)
    position = 0
    try:
        with distributor(render, writer.folder, cluster, observer) as workers:
            ended = (
                (item.args[0], shape)
                for item, shape in workers.run(Item((n,), plan.names[n]) for n in missing)
            )
            for number, result in chain(in_set, ended):
                rendered[number] = result
                while position in rendered:
                    shape = rendered[position]
                    if isinstance(shape, str):
                        path = _path(writer.folder, position)
                        plan.add(writer, position, shape, entries.load_rendered(path))
                        path.unlink()
                    if not isinstance(shape, LostError):
                        finish(position)
                    position += 1
    finally:
        for number in missing:
            _path(writer.folder, number).unlink(missing_ok=True)
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
