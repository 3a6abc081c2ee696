"""HTML pages of results: one page with relighting for each capture, and index.html."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from splinecli._version import __version__
from splinecli.capture.formats.facts import read_header
from splinecli.capture.formats.images import decode_image, image_bytes
from splinecli.errors import InputError, OutputError
from splinecli.maths import Bools, Float32Array, Picture
from splinecli.maths.normals import unit
from splinecli.pictures.maps import PREVIEW_LIGHT, TICKS, TOP_DEG, colour_errors, encode_png
from splinecli.records.output_files import MAPS, NORMALS, PAGE, REPORT
from splinecli.results.files import read_report
from splinecli.results.maps import map_picture
from splinecli.results.material import PAGE_CAPTIONS, page_pictures
from splinecli.system.machine import is_out_of_memory


def picture_url(file: bytes, kind: str = "png") -> str:
    """Return a data URL that embeds a PNG or JPEG file in a page."""
    return f"data:image/{kind};base64,{base64.b64encode(file).decode('ascii')}"


def render(template: str, **values: object) -> str:
    """Return the page rendered from a template and values.

    Values are escaped; a missing value is an error.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("splinecli", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(version=__version__, **values).rstrip() + "\n"


# largest number of pixels on a page, so that browsers can open the file; larger maps are reduced
LARGEST_MAP = 8_000_000
LONGEST_SIDE = 8192  # longest side in pixels that most devices can draw
# bits in addition to the 8 bits of a picture: 13 bits represent a normal within 0.01 degrees, and
# more would be noise
LOW_BITS = 5
_LARGEST_CODE = 2 ** (8 + LOW_BITS) - 1  # represents a component of 1
_EDGE_SIGMA = 1.2  # width in pixels of the blur that smooths the outline of the mask
_TIMES = "\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}"


def result_page(
    report: Mapping[str, Any],
    normal_map: Float32Array,
    mask: Bools,
    *,
    values: Mapping[str, Float32Array] | None = None,
    material: Float32Array | None = None,
    error_map_deg: Float32Array | None = None,
    pictures: Mapping[str, bytes] | None = None,
) -> str:
    """Return an HTML file that contains everything it shows and loads nothing from a network.

    Maps that exceed LARGEST_MAP or LONGEST_SIDE are reduced, keeping their aspect ratio, and the
    page states the reduced size. A pixel of a reduced map is the mean of the values in its area
    that are in the mask (or have an error); mean normals are rescaled to unit length. The figures
    on the page come from the report and refer to all pixels. Raises OutputError if a picture cannot
    be encoded.

    Args:
        report: a report of `infer` (docs/infer.md); `files` and `surface` may be missing. Lengths
            on the page are in millimetres if the surface is, otherwise in pixels of the full-size
            maps.
        normal_map: (H, W, 3), unit in the mask; x right, y up, z to the camera.
        mask: (H, W), not empty.
        values: (H, W) or (H, W, C), by name, for the maps in MAPS that are on the page.
        material: (H, W, 7), see splinecli.results.material; determines how the page reflects light.
            If it is None, the page uses the albedo and a highlight that the reader can adjust.
        error_map_deg: (H, W) degrees, NaN where the error is unknown.
        pictures: further pictures (PNG) by caption.
    """
    normals, shown = _reduce(normal_map, mask, LARGEST_MAP)
    values = values or {}
    maps = dict(zip(("high", "low"), split_normals(unit(normals), shown), strict=True))
    error_png, exposure, captions = None, 0.0, {name: MAPS[name].caption for name in values}
    for name, whole in values.items():
        reduced, _ = _reduce(np.atleast_3d(whole), mask, LARGEST_MAP)
        reduced = reduced.reshape(*shown.shape, *whole.shape[2:])
        maps[name] = map_picture(MAPS[name], reduced, shown)
    if material is not None:
        maps |= page_pictures(_reduce(material, mask, LARGEST_MAP)[0])
        captions |= PAGE_CAPTIONS
        bright = float(np.quantile(material[mask][:, :3].max(axis=1), 0.99))  # is shown as white
        exposure = round(float(-np.log2(np.clip(bright, 1 / 16, 16))), 1)
    if error_map_deg is not None:
        known = np.isfinite(error_map_deg)
        values_deg, known = _reduce(error_map_deg[..., None], known, LARGEST_MAP)
        error_png = _data_url(colour_errors(np.where(known, values_deg[..., 0], np.nan)))
    first = _first_pictures(maps, normals, shown) if shown.size > 500_000 else {}
    (height, width), size = shown.shape, _size(shown)
    is_reduced = shown.shape != mask.shape
    stops = colour_errors(np.linspace(0, TOP_DEG, 16)[None])[0]
    errors = report["angular_error_deg"] or {}
    words = {"mean": "Mean", "median": "Median", "p90": "90th percentile"}
    figures = [(word, f"{errors[name]:.2f}°") for name, word in words.items() if errors]
    figures += [
        (f"Under {limit}°", f"{errors[f'under_{limit}']:.1%}") for limit in (5, 10) if errors
    ]
    millimetres = (report.get("surface") or {}).get("pixel_size_mm")
    return render(
        "page.html",
        title=report["capture"],
        report=report,
        facts=_facts(report, size if is_reduced else None),
        reduced=f"This page shows {size} of the {_size(mask)} pixels. The other files have all"
        " pixels."
        if is_reduced
        else None,
        unit="pixels" if millimetres is None else "mm",
        units_per_pixel=mask.shape[1] / width * (millimetres or 1),
        errors=figures,
        width=width,
        height=height,
        light=unit(np.array(PREVIEW_LIGHT))[:2].round(4).tolist(),
        low_scale=2**LOW_BITS,
        edge_slope=round(1 / (_EDGE_SIGMA * (2 * np.pi) ** 0.5), 3),
        largest_code=_LARGEST_CODE,
        first={name: _data_url(picture) for name, picture in first.items()},
        maps={name: _data_url(picture) for name, picture in maps.items()},
        captions=captions,
        exposure=exposure,
        error_map=error_png,
        pictures={caption: picture_url(png) for caption, png in (pictures or {}).items()},
        error_colours=", ".join(f"rgb({r} {g} {b})" for r, g, b in stops),
        error_ticks=[f"{value:g}°" for value in TICKS],
    )


def split_normals(normals: Float32Array, mask: Bools) -> tuple[Picture, Picture]:
    """Return unit normals (H, W, 3) as two RGB pictures, of upper and lower bits.

    The first picture contains the upper 8 bits of (n + 1) / 2, like the usual picture of a normal
    map. It is black outside the mask (H, W), and only there, because no unit normal is near (-1,
    -1, -1). The second contains the LOW_BITS below and, in its upper bits, the blurred mask. To
    keep thin parts, blurring does not move any pixel across the level of 1/2. The pictures have no
    alpha channel, because a browser would multiply the colours by it.
    """
    import cv2

    codes = np.rint((normals + 1) / 2 * _LARGEST_CODE).astype(np.uint16) * mask[..., None]
    blurred = cv2.GaussianBlur(
        mask.astype(np.float32), (0, 0), _EDGE_SIGMA, borderType=cv2.BORDER_REPLICATE
    )
    blurred = np.where(mask, np.maximum(blurred, 0.52), np.minimum(blurred, 0.48))
    level = np.rint(255 * blurred).astype(np.uint16)[..., None]
    low = (codes & (2**LOW_BITS - 1)) | ((level >> (5, 2, 0) & (7, 7, 3)) << LOW_BITS)
    return (codes >> LOW_BITS).astype(np.uint8), low.astype(np.uint8)


def _first_pictures(
    maps: Mapping[str, Picture], normals: Float32Array, mask: Bools
) -> dict[str, Picture]:
    """Return small pictures of the maps, which a browser shows while it loads the others.

    They have at most 100,000 pixels.
    """
    import cv2

    small, known = _reduce(normals, mask, 100_000)
    first = dict(zip(("high", "low"), split_normals(unit(small), known), strict=True))
    for name in maps.keys() - first.keys():
        reduced = cv2.resize(maps[name], known.shape[::-1], interpolation=cv2.INTER_AREA)
        first[name] = np.asarray(reduced, np.uint8)
    return first


def _reduce(values: Float32Array, known: Bools, largest: int) -> tuple[Float32Array, Bools]:
    """Return values (H, W, C) and their mask at a reduced size.

    The result has at most `largest` pixels, and sides of at most LONGEST_SIDE. A reduced value is
    the mean of the known values in its area, and is known if at least one of them is.
    """
    import cv2

    height, width = known.shape
    shrink = min(LONGEST_SIDE / max(height, width), (largest / known.size) ** 0.5)
    if shrink >= 1:
        return values, known
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None]
    # Channels are reduced one by one, because OpenCV supports at most four.
    channels = (np.where(known, channel, 0) for channel in np.moveaxis(values, 2, 0))
    total = np.dstack([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in channels])
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 0), weight[..., 0] > 0


def _size(mask: Bools) -> str:
    height, width = mask.shape
    return f"{width}{_TIMES}{height}"


def _facts(report: Mapping[str, Any], reduced: str | None) -> list[tuple[str, str]]:
    """Return pairs of terms and values.

    If the maps on the page were reduced, `reduced` is their size.
    """
    weights, expected = report["weights"], report["expected_under_5"]
    # excluding the time for this page and later stages
    stages = [(name, n) for name, n in report["seconds"].items() if n >= 0.05 and name != "total"]
    condition = "" if report["capture_judged"] else ", if the lights and the images are right"
    facts = [
        ("Method", report["method"]),
        ("Weights", weights and weights["name"]),
        ("Lights", str(report["n_lights"])),
        ("Pixels", f"{report['n_pixels']:,}"),
        ("Size", _TIMES.join(map(str, report["image_size"]))),
        (
            "Likely within 5°",
            None if expected is None else f"{expected:.0%} of the pixels{condition}",
        ),
        ("Size on this page", reduced),
        ("Seconds", ", ".join(f"{name.replace('_', ' ')} {n:.1f}" for name, n in stages)),
        ("Device", f"{report['device']}, {report['precision']}"),
    ]
    return [(term, value) for term, value in facts if value is not None]


def _data_url(picture: Picture) -> str:
    return picture_url(encode_png(picture))


INDEX = "index.html"


class IndexRow(NamedTuple):
    """One row of the overview as text. A failed capture has only its name and the error."""

    capture: str
    lights: str = ""
    pixels: str = ""
    mae: str = ""
    likely: str = ""
    warnings: str = ""
    seconds: str = ""
    error: str = ""


HEADER = IndexRow(
    "capture", "lights", "pixels", "MAE", "likely within 5°", "warnings", "seconds", "error"
)


class IndexEntry(NamedTuple):
    """A capture on the overview page: its row, the names of its files, and its warnings."""

    row: IndexRow
    files: tuple[str, ...] = ()
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, report: Mapping[str, Any]) -> IndexEntry:
        """Return the entry for a report, or for a document with `capture` and `error`."""
        if "error" in report:
            return cls(IndexRow(report["capture"], error=report["error"]))
        errors, expected = report["angular_error_deg"], report["expected_under_5"]
        seconds, warnings = report["seconds"], report["warnings"]
        row = IndexRow(
            report["capture"],
            lights=str(report["n_lights"]),
            pixels=f"{report['n_pixels']:,}",
            mae="" if errors is None else f"{errors['mean']:.2f}°",
            likely="" if expected is None else f"{expected:.0%}",
            warnings=str(len(warnings) or ""),
            seconds=f"{seconds.get('total', sum(seconds.values())):.1f}",
        )
        words = tuple(str(warning["text"]) for warning in warnings)
        return cls(row, tuple(report["files"]), words)


def index_page(entries: Sequence[IndexEntry], output: Path) -> str:
    """Return the overview page for the folder that contains the results, with thumbnails and
    links.
    """
    rows = []
    for row, files, words in entries:
        # Quote the bytes, because the name of a folder may not be valid text.
        folder = quote(os.fsencode(row.capture))
        picture = next((name for name in (NORMALS["png8"], NORMALS["png"]) if name in files), None)
        shown = {**row._asdict(), "words": words, "page": None, "picture": None, "thumbnail": None}
        shown["files"] = [(name, f"{folder}/{quote(name)}") for name in files]
        if PAGE in files:
            shown["page"] = f"{folder}/{PAGE}"
        if picture is not None:
            shown["picture"] = f"{folder}/{picture}"
            shown["thumbnail"] = _thumbnail(output / row.capture / picture)
        rows.append(shown)
    return render("index.html", title=f"{len(entries)} captures", header=HEADER, rows=rows)


def _thumbnail(path: Path) -> str | None:
    """Return a picture of at most 256 x 192 pixels as a JPEG data URL; None if it cannot be read.

    On the page, it has half this size, to be sharp on high-resolution screens.
    """
    import cv2

    try:
        # This is 33 megapixels of 16 bits. Larger files may be decompression bombs.
        if image_bytes(*read_header(path).size) > 10**9:
            return None
        picture = decode_image(path)
    except InputError:
        return None
    if picture.dtype.kind != "u":
        return None
    height, width = picture.shape[:2]
    shrink = min(1, 256 / width, 192 / height)
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) / np.iinfo(picture.dtype).max
    done, jpeg = cv2.imencode(".jpg", np.rint(255 * small[..., ::-1]).astype(np.uint8))
    return picture_url(jpeg.tobytes(), "jpeg") if done else None


def with_earlier(entries: Sequence[IndexEntry], folder: Path) -> list[IndexEntry]:
    """Return the entries, followed by other captures with results in the folder, sorted by name."""
    names = {entry.row.capture for entry in entries}
    earlier = []
    for path in sorted(folder.glob(f"*/{REPORT}")):
        if path.parent.name in names or path.parent.is_symlink():
            continue
        try:
            entry = IndexEntry.of(read_report(path.parent))
        except Exception as error:  # a report from elsewhere may be invalid in any way
            if is_out_of_memory(error):
                raise
            continue
        if entry.row.capture == path.parent.name:
            earlier.append(entry)
    return [*entries, *earlier]


def has_index(folder: Path) -> bool:
    """Return whether the folder contains an index.html written by splinecli."""
    with suppress(OSError):
        if (folder / INDEX).is_file():
            with (folder / INDEX).open("rb") as file:
                # The tag is near the top.
                return b'<meta name="generator" content="splinecli">' in file.read(1 << 16)
    return False


def check_index_free(folder: Path, *, overwrite: bool) -> None:
    """Raise OutputError if the folder contains an index.html from elsewhere, without
    `overwrite`.
    """
    path = folder / INDEX
    if path.is_dir() or (path.exists() and not overwrite and not has_index(folder)):
        raise OutputError(
            "the file was not written by splinecli",
            path=path,
            hint="Add --overwrite, or choose another -o",
        )
