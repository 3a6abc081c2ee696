"""The results of one capture as one HTML file: a view under a movable light, pictures of the maps, figures."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.normals import unit
from splinecli.pictures.error_map import TOP_DEG, colour_errors
from splinecli.pictures.maps import PREVIEW_LIGHT, albedo_picture, confidence_picture
from splinecli.pictures.png import Picture, encode_png
from splinecli.results.templates import render

LONGEST_SIDE = 1600
"""Largest width or height of the maps on a page in pixels: a screen shows no more, and the file stays small."""

LOW_BITS = 5
"""Bits of a normal's component below the 8 bits of a picture.

13 bits keep a normal within 0.01 degrees, where 8 bits would show bands in a highlight. More bits would be noise,
which PNG cannot compress, and would make the file twice as large.
"""

_TIMES = "\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}"


def result_page(
    report: Mapping[str, Any],
    normal_map: NDArray[np.float32],
    mask: NDArray[np.bool_],
    *,
    albedo: NDArray[np.float32] | None = None,
    confidence_map: NDArray[np.float32] | None = None,
    error_map_deg: NDArray[np.float32] | None = None,
) -> str:
    """Return one HTML file that contains everything it shows and loads nothing from a network.

    Maps with a side over LONGEST_SIDE pixels are reduced to it, with their proportions kept. A pixel of a reduced map
    is the mean of the values that are in the mask (or have an error) in its area; mean normals are scaled to unit
    length. The page states its size then. The figures on the page are those of the report, over all pixels.

    Args:
        report: a report of `infer` (docs/infer.md); `seconds.write` and `files` may be missing.
        normal_map: (H, W, 3), unit in the mask; x right, y up, z to the camera.
        mask: (H, W), not empty.
        albedo: (H, W, 3), linear, from albedo_map.
        confidence_map: (H, W), probabilities.
        error_map_deg: (H, W) degrees, NaN where there is no error.

    Raises:
        OutputError: a picture cannot be encoded.
    """
    normals, shown = _reduce(normal_map, mask)
    high, low = split_normals(unit(normals), shown)
    albedo_png = confidence_png = error_png = None
    if albedo is not None:
        albedo_png = _data_url(albedo_picture(_reduce(albedo, mask)[0], shown))
    if confidence_map is not None:
        confidence_png = _data_url(confidence_picture(_reduce(confidence_map[..., None], mask)[0][..., 0]))
    if error_map_deg is not None:
        errors, known = _reduce(error_map_deg[..., None], np.isfinite(error_map_deg))
        error_png = _data_url(colour_errors(np.where(known, errors[..., 0], np.nan), TOP_DEG))
    height, width = shown.shape
    return render(
        "page.html",
        title=report["capture"],
        report=report,
        facts=_facts(report, reduced=(width, height) if shown.shape != mask.shape else None),
        errors=_errors(report),
        width=width,
        height=height,
        light=unit(np.array(PREVIEW_LIGHT))[:2].round(4).tolist(),
        low_scale=2**LOW_BITS,
        largest_code=_largest_code(),
        high=_data_url(high),
        low=_data_url(low),
        albedo=albedo_png,
        confidence=confidence_png,
        error_map=error_png,
        error_colours=_error_colours(),
        error_ticks=[f"{TOP_DEG * third / 3:g}°" for third in range(4)],
    )


def split_normals(normals: NDArray[np.float32], mask: NDArray[np.bool_]) -> tuple[Picture, Picture]:
    """Return unit normals (H, W, 3) as two RGB pictures: the upper 8 bits of (n + 1) / 2, and the LOW_BITS below.

    The first is the usual picture of a normal map. Both are black outside the mask (H, W). A pixel that is black in
    the first picture is outside, since no unit normal is near (-1, -1, -1). The pictures have no alpha channel,
    because a browser would multiply the colours by it.
    """
    codes = np.rint((normals + 1) / 2 * _largest_code()).astype(np.uint16) * mask[..., None]
    return (codes >> LOW_BITS).astype(np.uint8), (codes & (2**LOW_BITS - 1)).astype(np.uint8)


def _largest_code() -> int:
    """Return the number that stands for a component of 1."""
    return int(2 ** (8 + LOW_BITS) - 1)


def _reduce(
    values: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return values (H, W, C) and their mask, both reduced until no side is over LONGEST_SIDE pixels.

    A reduced value is the mean of the known values in its area, and is known if one of them is.
    """
    import cv2

    height, width = known.shape
    shrink = LONGEST_SIDE / max(height, width)
    if shrink >= 1:
        return values, known
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None]
    total = cv2.resize(np.where(known[..., None], values, 0), size, interpolation=cv2.INTER_AREA)
    total = total.reshape(*weight.shape[:2], -1)  # OpenCV drops an axis of one channel
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 0), weight[..., 0] > 0


def _facts(report: Mapping[str, Any], *, reduced: tuple[int, int] | None) -> list[tuple[str, str]]:
    """Return terms and values; `reduced` is the width and height of the page's maps if they were reduced."""
    weights, expected = report["weights"], report["expected_under_5"]
    return [
        ("Method", report["method"]),
        *([] if weights is None else [("Weights", weights["name"])]),
        ("Lights", str(report["n_lights"])),
        ("Pixels", f"{report['n_pixels']:,}"),
        ("Size", _TIMES.join(map(str, report["image_size"]))),
        *([] if expected is None else [("Likely within 5°", f"{expected:.0%} of the pixels")]),
        *([] if reduced is None else [("Size on this page", _TIMES.join(map(str, reduced)))]),
        ("Seconds", ", ".join(f"{step} {seconds:g}" for step, seconds in report["seconds"].items())),
        ("Device", f"{report['device']}, {report['precision']}"),
    ]


def _errors(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    errors = report["angular_error_deg"]
    if errors is None:
        return []
    return [
        ("Mean", f"{errors['mean']:.2f}°"),
        ("Median", f"{errors['median']:.2f}°"),
        ("90th percentile", f"{errors['p90']:.2f}°"),
        ("Under 5°", f"{errors['under_5']:.1%}"),
        ("Under 10°", f"{errors['under_10']:.1%}"),
    ]


def _error_colours() -> str:
    """Return the colours of the error map, from 0 to TOP_DEG, as stops of a CSS gradient."""
    stops = colour_errors(np.linspace(0, TOP_DEG, 16)[None], TOP_DEG)[0]
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in stops)


def _data_url(picture: Picture) -> str:
    return f"data:image/png;base64,{base64.b64encode(encode_png(picture)).decode('ascii')}"
