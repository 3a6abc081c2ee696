"""Report on a capture: the data that `infer` would read, and the time and memory that it would
need.
"""

from dataclasses import replace
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from splinecli.capture import CaptureSource
from splinecli.capture.channel_lights import CHANNELS
from splinecli.capture.light_files import encode_lights, light_encoder
from splinecli.errors import OutputError, UsageError
from splinecli.judge.light_check import candidate_rows
from splinecli.lights.calibration.balls import find_view
from splinecli.pictures.capture_sheet import sheet_of
from splinecli.pictures.plots import sky_plot
from splinecli.pipeline.expected_seconds import expected_seconds
from splinecli.pipeline.folder_settings import SETTINGS, read_settings, settings_text
from splinecli.pipeline.incoming import unpacked
from splinecli.pipeline.infer import BASE_BYTES, infer_bytes
from splinecli.pipeline.infer_options import FolderSettings, InfoOptions, ReadingOptions
from splinecli.recipe.steps import begin, follow, images_to_read
from splinecli.recipe.work import Work
from splinecli.records.capture_warnings import LIGHTS_MENDED
from splinecli.records.output_files import CAPTURE_SHEET
from splinecli.system.files import check_free, file_sha256, write_bytes
from splinecli.system.progress import SILENT, Observer

# Descriptions of the sources of a white level
ORIGINS = {
    "given": "given by --white-level",
    "file": "stated by the image files",
    "images": "found in the images",
    "full scale": "the full scale of the files",
}


def describe_capture(
    options: InfoOptions, reading: ReadingOptions | None = None, observer: Observer = SILENT
) -> dict[str, Any]:
    """Read a capture without estimating normals, write the requested files and return the report.

    `reading` contains the options with which `infer` would read the capture; if it is strict,
    skipped checks are also reported as warnings. Raises InputError, OutputError, or UsageError if
    the plot would be in the folder of the images, or if options cannot be used together.
    """
    reading, plot, mended_lights = reading or ReadingOptions(), options.plot, options.mended_lights
    with TemporaryDirectory() as frames:  # extracted from a video
        folder = unpacked(options.capture, Path(frames), reading, observer, redo="all")
        settings = _settings(options, reading, folder) if options.write_settings else None
        auto_mask = options.auto_mask or bool(
            reading.mask is None and read_settings(folder, FolderSettings).get("auto_mask")
        )
        if settings is None:  # otherwise, the settings to be written replace them
            reading = reading.with_settings(folder)
        source = reading.open(folder)
        _check_options(options, source)
        work = begin(
            source,
            None,
            replace(reading.recipe, auto_mask=auto_mask, asks_network=mended_lights is not None),
        )
        n_reads = images_to_read(work)
        with observer.progress("reading", n_reads) as advance:
            work = follow(work, advance=lambda amount, _: advance(amount))
        capture, judgement = work.made, work.judgement
        assert judgement is not None  # the recipe judges
        if settings is not None:  # they have been shown to work
            write_bytes(folder / SETTINGS, settings)
        if plot is not None:
            errors_deg = capture.light_errors_deg
            picture = sky_plot(capture.light_directions, capture.name, errors_deg=errors_deg)
            write_bytes(plot, picture)
        if options.output is not None:
            sheet = Path(options.output) / capture.name / CAPTURE_SHEET
            write_bytes(sheet, sheet_of(work.files, capture))
        check, warnings = judgement.light_check, [*capture.warnings, *judgement.warnings]
        for warning in warnings:
            observer.warn(str(warning))
        report = {
            **_report(work, n_reads),
            "warnings": [str(warning) for warning in warnings],
            "warning_codes": [warning.code for warning in warnings],
            "mended": list(capture.mended),
        }
        if mended_lights is not None:
            mended = judgement.mended_lights
            if any(warning.kind is LIGHTS_MENDED for warning in capture.warnings):
                mended = capture.light_directions
            if mended is not None:
                write_bytes(
                    mended_lights, encode_lights(mended_lights, mended, source.files.images)
                )
            report["mended_lights"] = None if mended is None else str(mended_lights)
        if options.check_lights:
            report["light_candidates"] = [] if check is None else candidate_rows(check)
        return report


def summary_lines(report: dict[str, Any]) -> list[str]:
    """Return the lines of the human-readable report."""
    types = {"uint8": "8 bits", "uint16": "16 bits"}
    kinds = ", ".join(
        f"{kind['size'][0]} x {kind['size'][1]}, {'gray' if kind['channels'] == 1 else 'RGB'},"
        f" {types.get(kind['type'], kind['type'])}"
        for kind in report["image_kinds"]
    )
    estimated = report["estimated_lights"]
    nearest, farthest = report["axis_angle_deg"]
    lights = report["light_directions"] or "estimated from the images"
    angles = (
        f"{nearest:.0f} to {farthest:.0f}"
        if f"{nearest:.0f}" != f"{farthest:.0f}"
        else f"{nearest:.0f}"
    )
    lights += f", {angles} degrees from the camera axis"
    intensities = (
        report["light_intensities"] or "none: equal, or estimated if equal ones do not fit"
    )
    if estimated is not None and estimated["intensities"] is not None:
        intensities = "estimated from the images"
    exposure, level = report["exposure"], report["white_level"]
    named = (report["first_image"], report["last_image"])
    dark, bright = exposure["bright"]
    rows = [
        ("capture", f"{report['capture']} ({report['layout']})"),
        ("images", f"{report['images']} ({' ... '.join(dict.fromkeys(named))}): {kinds}"),
        ("lights", lights),
        *([("lamps", report["lamps"])] if report["lamps"] else []),
        *([("camera", camera)] if (camera := _camera_in_words(report)) else []),
        ("intensities", intensities),
        *([("reads", report["reads"])] if report["reads"] else []),
        ("mask", f"{report['mask'] or 'none: all pixels'} ({report['n_pixels']} pixels)"),
        ("ground truth", report["ground_truth"] or "none"),
        (
            "white level",
            f"{level['value']:g}, {ORIGINS[level['origin']]}" if level else "none: floating-point",
        ),
        (
            "exposure",
            f"brightest 1 % from {100 * dark:.0f} to {100 * bright:.0f} % of the white level, at"
            f" most {100 * exposure['saturated']:.1f} % of an image saturated",
        ),
        (
            "expect",
            f"{report['expect']['memory_mib']} MiB of memory and about"
            f" {report['expect']['seconds']} s on this machine,"
            f" {report['expect']['seconds_with_surface']} s with --surface",
        ),
        ("weights", f"spline-net, SHA-256 {report['weights']['spline-net'][:16]}..."),
    ]
    if report["light_directions"]:
        text = "faults that only the network's normals reveal; infer also checks for these"
        rows.append(("not checked", text))
    if "mended_lights" in report:
        nothing = "not written, because no other reading of the lights fits clearly better"
        rows.append(("mended", report["mended_lights"] or nothing))
    return [f"{name:13}{text}" for name, text in rows] + _candidate_lines(
        report.get("light_candidates")
    )


def _camera_in_words(report: dict[str, Any]) -> str | None:
    """Return a description of the camera; None if nothing is known about it."""
    matrix, of_exif = report["camera_matrix"], report["exif_camera_matrix"]
    if matrix is not None:
        return f"perspective, focal length {matrix[0][0]:.6g} pixels"
    if of_exif is None:
        return None
    rows = ", ".join(" ".join(f"{number:.6g}" for number in row) for row in of_exif)
    return f"treated as orthographic; EXIF suggests a --camera-matrix with the rows {rows}"


def _candidate_lines(candidates: list[dict[str, Any]] | None) -> list[str]:
    """Return a table of the readings of the light file; empty unless it was requested."""
    if not candidates:
        return []
    width = max(30, *(len(row["reading"]) + 2 for row in candidates))
    lines = [
        f"{'reading of the light file':{width}}"
        f"{'misfit':>8}{'curl':>8}{'outline':>9}{'advantage':>11}"
    ]
    for row in candidates:
        misfit = "-" if row["misfit"] is None else f"{100 * row['misfit']:.0f} %"
        curl, rim, advantage = (
            "-" if row[key] is None else f"{row[key]:{form}}"
            for key, form in (("curl", ".2f"), ("rim", "+.2f"), ("advantage", "+.2f"))
        )
        lines.append(f"{row['reading']:{width}}{misfit:>8}{curl:>8}{rim:>9}{advantage:>11}")
    return [
        *lines,
        "misfit: residual of the images relative to lights in random order, for comparing orders",
        "advantage: evidence from curl and outline over the file as given; from 1 on, infer warns",
    ]


def _settings(options: InfoOptions, reading: ReadingOptions, folder: Path) -> bytes:
    """Return the content of splinecli.toml for the folder of a capture.

    Raises UsageError if no option is given, an option names a file outside the folder, or the
    capture is a video; OutputError if the folder contains another splinecli.toml.
    """
    if folder != options.capture:
        raise UsageError(
            "--write-settings needs a folder, not a video", hint="Leave --write-settings out"
        )
    given = {name: getattr(reading, name) for name in reading.__struct_fields__}
    settings = FolderSettings(**given, auto_mask=options.auto_mask)
    text = settings_text(settings, FolderSettings, folder)
    if not text:
        raise UsageError(
            "--write-settings needs options to write",
            hint="Add options for reading the capture, or leave --write-settings out",
        )
    path = folder / SETTINGS
    if path.exists() and not options.overwrite and path.read_bytes() != text.encode():
        hint = "Add --overwrite to replace it, or change its lines"
        raise OutputError("already exists with other settings", path, hint=hint)
    return text.encode()


def _check_options(options: InfoOptions, source: CaptureSource) -> None:
    """Raise UsageError or OutputError, before reading images, if a file is missing or cannot be
    written.
    """
    plot, mended_lights = options.plot, options.mended_lights
    for name, given in (
        ("--check-lights", options.check_lights),
        ("--mended-lights", mended_lights is not None),
    ):
        if given and not source.has_lights:
            raise UsageError(
                f"{name} needs a light file, but the lights are estimated",
                hint=f"Add --lights FILE, or leave {name} out",
            )
    if plot is not None:
        if plot.absolute().parent in {path.absolute().parent for path in source.files.images}:
            problem = f"the plot {plot} would be read as an image of the capture in this folder"
            raise UsageError(problem, hint="Choose another folder for the plot")
        check_free(plot.parent, [plot.name], overwrite=options.overwrite)
    if options.output is not None:
        folder = Path(options.output) / source.name
        check_free(folder, [CAPTURE_SHEET], overwrite=options.overwrite)
    if mended_lights is not None:
        light_encoder(mended_lights)
        if source.lamps is not None and source.lamps.used:
            raise UsageError("--mended-lights writes directions, but the lights are near lamps")
        check_free(mended_lights.parent, [mended_lights.name], overwrite=options.overwrite)


def _report(work: Work, n_reads: int) -> dict[str, Any]:
    source, capture, images = work.files, work.made, work.images
    files, level = source.files, capture.white_level
    height, width = work.shape
    channels = None if source.channels is None else CHANNELS
    kinds = sorted({(channels or image.channels, image.dtype) for image in images})
    angles = np.degrees(np.arccos(capture.light_directions[:, 2].clip(-1, 1)))
    bright = [image.bright for image in images]
    intensities, view = files.light_intensities, find_view(source.facts[0], None)
    stages = expected_seconds(
        capture.n_pixels,
        len(images) * height * width,
        read_pixels=n_reads * height * width,
        align=work.options.align,
    )
    seconds = 3 + sum(stages.values())  # 3 to load the libraries and the network
    largest = (height, width, images[0].channels), np.dtype(images[0].dtype).itemsize
    memory = BASE_BYTES + infer_bytes(largest, capture.n_pixels, source.n_lights)
    found = None
    if capture.light_errors_deg is not None:
        unequal = work.found_intensities
        found = {
            "directions": capture.light_directions.round(6).tolist(),
            "errors_deg": capture.light_errors_deg.round(2).tolist(),
            "intensities": None if unequal is None else unequal.round(4).tolist(),
        }

    def text(path: Path | None) -> str | None:
        return None if path is None else str(path)

    if (
        intensities is None
        and source.intensities_measured
        and (source.light_intensities != 1).any()
    ):
        intensities = files.light_directions  # AliceVision's light files contain both
    return {
        "capture": files.name,
        "layout": files.layout,
        # with lights in channels, each image is listed for every channel
        "images": len({image.path for image in images}),
        "first_image": images[0].path.name,
        "last_image": images[-1].path.name,
        "image_kinds": [
            {"size": [width, height], "channels": count, "type": dtype} for count, dtype in kinds
        ],
        "reads": source.window.in_words(),
        "n_pixels": capture.n_pixels,
        "light_source": "given" if found is None else "estimated",
        "light_directions": text(files.light_directions),
        "estimated_lights": found,
        "lamps": None if source.lamps is None else source.lamps.in_words(),
        "camera_matrix": None if source.camera_matrix is None else source.camera_matrix.tolist(),
        "exif_camera_matrix": view.matrix.round(1).tolist() if view.known else None,
        "light_intensities": text(intensities),
        "mask": text(files.mask) if source.automatic_mask is None else "found in the images",
        "ground_truth": text(files.ground_truth),
        "axis_angle_deg": [round(float(angles.min()), 1), round(float(angles.max()), 1)],
        "white_level": None if level is None else {"value": level.value, "origin": level.origin},
        "exposure": {
            "bright": [round(min(bright), 4), round(max(bright), 4)],
            "saturated": round(max(image.saturated for image in images), 4),
        },
        "expect": {
            "memory_mib": round(memory / 2**20),
            "seconds": round(seconds),
            # 50,000 pixels per second: integration, mesh and their files on one core
            "seconds_with_surface": round(seconds + capture.n_pixels / 50_000),
        },
        "weights": shipped_checksums(),
    }


def shipped_checksums() -> dict[str, str]:
    """Return the SHA-256 of each weight file in the package, by name."""
    with resources.as_file(resources.files("splinecli") / "assets") as folder:
        return {path.stem: file_sha256(path) for path in sorted(folder.glob("*.safetensors"))}
