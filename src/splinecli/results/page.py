"""The results of one capture as one HTML file: a view under a movable light, pictures of the maps, figures."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.maths.normals import unit
from splinecli.pictures.maps import PREVIEW_LIGHT, TICKS, TOP_DEG, albedo_picture, colour_errors, confidence_picture
from splinecli.pictures.png import Picture, encode_png
from splinecli.results.templates import picture_url, render

LARGEST_MAP = 8_000_000  # pixels of the maps on a page; larger ones are reduced, so that browsers can open the file
LONGEST_SIDE = 8192  # pixels: most devices draw pictures up to this side
QUICK_MAP, FIRST_MAP = 500_000, 100_000  # pixels: above the first, a page begins with maps of the second

LOW_BITS = 5  # below the 8 bits of a picture: 13 bits keep a normal within 0.01 degrees; more would be noise

_LARGEST_CODE = 2 ** (8 + LOW_BITS) - 1  # stands for a component of 1
_TIMES = "\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}"


def result_page(
    report: Mapping[str, Any],
    normal_map: NDArray[np.float32],
    mask: NDArray[np.bool_],
    *,
    albedo: NDArray[np.float32] | None = None,
    confidence_map: NDArray[np.float32] | None = None,
    error_map_deg: NDArray[np.float32] | None = None,
    light_plot: bytes | None = None,
) -> str:
    """Return one HTML file that contains everything it shows and loads nothing from a network.

    Maps over LARGEST_MAP or LONGEST_SIDE are reduced, with their proportions kept. A pixel of a reduced map is the mean
    of the values that are in the mask (or have an error) in its area; mean normals are scaled to unit length. The page
    states its size then. The figures on the page are those of the report, over all pixels. Raises OutputError if a
    picture cannot be encoded.

    Args:
        report: a report of `infer` (docs/infer.md); `files` and `surface` may be missing. Lengths on
            the page are in millimetres if its surface is, else in pixels of the whole maps.
        normal_map: (H, W, 3), unit in the mask; x right, y up, z to the camera.
        mask: (H, W), not empty.
        albedo: (H, W, 3), linear, from albedo_map.
        confidence_map: (H, W), probabilities.
        error_map_deg: (H, W) degrees, NaN where there is no error.
        light_plot: a PNG of the lights, where they were found from the images.
    """
    normals, shown = _reduce(normal_map, mask, LARGEST_MAP)
    maps = dict(zip(("high", "low"), split_normals(unit(normals), shown), strict=True))
    error_png = None
    if albedo is not None:
        maps["albedo"] = albedo_picture(_reduce(albedo, mask, LARGEST_MAP)[0], shown)
    if confidence_map is not None:
        reduced = _reduce(confidence_map[..., None], mask, LARGEST_MAP)[0][..., 0]
        maps["confidence"] = confidence_picture(reduced)
    if error_map_deg is not None:
        errors, known = _reduce(error_map_deg[..., None], np.isfinite(error_map_deg), LARGEST_MAP)
        error_png = _data_url(colour_errors(np.where(known, errors[..., 0], np.nan)))
    first = _first_pictures(maps, normals, shown) if shown.size > QUICK_MAP else {}
    (height, width), size = shown.shape, _size(shown)
    is_reduced = shown.shape != mask.shape
    stops = colour_errors(np.linspace(0, TOP_DEG, 16)[None])[0]
    figures = report["angular_error_deg"]
    millimetres = (report.get("surface") or {}).get("pixel_size_mm")
    return render(
        "page.html",
        title=report["capture"],
        report=report,
        facts=_facts(report, size if is_reduced else None),
        reduced=f"This page shows {size} of the {_size(mask)} pixels. The other files have all of them."
        if is_reduced
        else None,
        unit="pixels" if millimetres is None else "mm",
        units_per_pixel=mask.shape[1] / width * (millimetres or 1),
        errors=[]
        if figures is None
        else [
            ("Mean", f"{figures['mean']:.2f}°"),
            ("Median", f"{figures['median']:.2f}°"),
            ("90th percentile", f"{figures['p90']:.2f}°"),
            ("Under 5°", f"{figures['under_5']:.1%}"),
            ("Under 10°", f"{figures['under_10']:.1%}"),
        ],
        width=width,
        height=height,
        light=unit(np.array(PREVIEW_LIGHT))[:2].round(4).tolist(),
        low_scale=2**LOW_BITS,
        largest_code=_LARGEST_CODE,
        first={name: _data_url(picture) for name, picture in first.items()},
        maps={name: _data_url(picture) for name, picture in maps.items()},
        error_map=error_png,
        light_plot=None if light_plot is None else picture_url(light_plot),
        error_colours=", ".join(f"rgb({r} {g} {b})" for r, g, b in stops),
        error_ticks=[f"{value:g}°" for value in TICKS],
    )


def split_normals(normals: NDArray[np.float32], mask: NDArray[np.bool_]) -> tuple[Picture, Picture]:
    """Return unit normals (H, W, 3) as two RGB pictures: the upper 8 bits of (n + 1) / 2, and the LOW_BITS below.

    The first is the usual picture of a normal map. Both are black outside the mask (H, W). A pixel that is black in
    the first picture is outside, since no unit normal is near (-1, -1, -1). The pictures have no alpha channel,
    because a browser would multiply the colours by it.
    """
    codes = np.rint((normals + 1) / 2 * _LARGEST_CODE).astype(np.uint16) * mask[..., None]
    return (codes >> LOW_BITS).astype(np.uint8), (codes & (2**LOW_BITS - 1)).astype(np.uint8)


def _first_pictures(
    maps: Mapping[str, Picture], normals: NDArray[np.float32], mask: NDArray[np.bool_]
) -> dict[str, Picture]:
    """Return the pictures of the maps in few pixels, which a browser shows while it reads the others."""
    import cv2

    small, known = _reduce(normals, mask, FIRST_MAP)
    first = dict(zip(("high", "low"), split_normals(unit(small), known), strict=True))
    for name in maps.keys() - first.keys():
        reduced = cv2.resize(maps[name], known.shape[::-1], interpolation=cv2.INTER_AREA)
        first[name] = np.asarray(reduced, np.uint8)
    return first


def _reduce(
    values: NDArray[np.float32], known: NDArray[np.bool_], largest: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return values (H, W, C) and their mask, reduced to `largest` pixels and sides of LONGEST_SIDE.

    A reduced value is the mean of the known values in its area, and is known if one of them is.
    """
    import cv2

    height, width = known.shape
    shrink = min(LONGEST_SIDE / max(height, width), (largest / known.size) ** 0.5)
    if shrink >= 1:
        return values, known
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None]
    total = cv2.resize(np.where(known[..., None], values, 0), size, interpolation=cv2.INTER_AREA)
    total = total.reshape(*weight.shape[:2], -1)  # OpenCV drops an axis of one channel
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 0), weight[..., 0] > 0


def _size(mask: NDArray[np.bool_]) -> str:
    height, width = mask.shape
    return f"{width}{_TIMES}{height}"


def _facts(report: Mapping[str, Any], reduced: str | None) -> list[tuple[str, str]]:
    """Return terms and values; `reduced` is the size of the page's maps if they were reduced."""
    weights, expected = report["weights"], report["expected_under_5"]
    seconds = report["seconds"].items()  # of the stages up to this page
    condition = "" if report["capture_judged"] else ", if the lights and the images are right"
    return [
        ("Method", report["method"]),
        *([] if weights is None else [("Weights", weights["name"])]),
        ("Lights", str(report["n_lights"])),
        ("Pixels", f"{report['n_pixels']:,}"),
        ("Size", _TIMES.join(map(str, report["image_size"]))),
        *([] if expected is None else [("Likely within 5°", f"{expected:.0%} of the pixels{condition}")]),
        *([] if reduced is None else [("Size on this page", reduced)]),
        ("Seconds", ", ".join(f"{name.replace('_', ' ')} {n:g}" for name, n in seconds if n and name != "total")),
        ("Device", f"{report['device']}, {report['precision']}"),
    ]


def _data_url(picture: Picture) -> str:
    return picture_url(encode_png(picture))
