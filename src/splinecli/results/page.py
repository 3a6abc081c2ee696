"""What `infer` found for a capture, as one HTML file: a view under a light that can be moved, pictures and figures."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.normals import unit
from splinecli.pictures.error_map import TOP_DEG, colour_errors
from splinecli.results.files import RAKING_LIGHT, albedo_picture, confidence_picture, encode_png
from splinecli.results.templates import render

LONGEST_SIDE = 1600
"""Pixels. Larger maps are reduced to it: a screen shows no more, and a page is to be mailed."""

LOW_BITS = 5
"""Below the 8 of a picture: 13 bits keep a normal within 0.01 degrees, where 8 bits would band a highlight. Those of
16 would be noise, which no PNG compresses, and half of the page. The page's script knows this number, too."""

_SIZE = "\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}"


def result_page(
    report: Mapping[str, Any],
    normal_map: NDArray[np.float32],
    mask: NDArray[np.bool_],
    *,
    albedo: NDArray[np.float32] | None = None,
    confidence_map: NDArray[np.float32] | None = None,
    error_map_deg: NDArray[np.float32] | None = None,
) -> str:
    """One HTML file that holds all it shows, and asks no network for anything.

    Maps with a side of more than LONGEST_SIDE pixels are reduced to it, keeping their proportions: each pixel of the
    page is the mean over the area it covers, of what lies in the mask (or has an error) there; mean normals get unit
    length again. The page says so. Its figures are the report's, of all pixels.

    Args:
        report: of the contract (docs/infer.md); `seconds.write` and `files` may be missing.
        normal_map: (H, W, 3), unit in the mask (H, W); x right, y up, z to the camera.
        albedo: (H, W, 3), linear, as albedo_map gives it.
        confidence_map: (H, W), probabilities.
        error_map_deg: (H, W) degrees, NaN where there is none.

    Raises:
        OutputError: a picture cannot be encoded.
    """
    normals, shown = _reduced(normal_map, mask)
    high, low = encode_halves(unit(normals), shown)
    albedo_png = confidence_png = error_png = None
    if albedo is not None:
        albedo_png = _data_url(albedo_picture(_reduced(albedo, mask)[0], shown))
    if confidence_map is not None:
        confidence_png = _data_url(confidence_picture(_reduced(confidence_map[..., None], mask)[0][..., 0]))
    if error_map_deg is not None:
        errors, known = _reduced(error_map_deg[..., None], np.isfinite(error_map_deg))
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
        light=unit(np.array(RAKING_LIGHT))[:2].round(4).tolist(),
        high=_data_url(high),
        low=_data_url(low),
        albedo=albedo_png,
        confidence=confidence_png,
        error_map=error_png,
        error_colours=_error_colours(),
        error_ticks=[f"{TOP_DEG * third / 3:g}°" for third in range(4)],
    )


def encode_halves(
    normals: NDArray[np.float32], mask: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Unit normals (H, W, 3) as two 8-bit RGB pictures: the upper 8 bits of (n + 1) / 2, and the LOW_BITS below.

    The first is the usual picture of a normal map; both are black outside the mask (H, W), where the first alone
    tells, as no unit normal is near (-1, -1, -1). Neither has an alpha channel, by which a browser would multiply.
    """
    codes = np.rint((normals + 1) / 2 * (2 ** (8 + LOW_BITS) - 1)).astype(np.uint16) * mask[..., None]
    return (codes >> LOW_BITS).astype(np.uint8), (codes & (2**LOW_BITS - 1)).astype(np.uint8)


def _reduced(
    values: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Values (H, W, C) with no side over LONGEST_SIDE: means over what is known; known where any of an area is."""
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
    """Terms and their values; `reduced`: width and height of a page's maps that are not the capture's."""
    weights, expected = report["weights"], report["expected_under_5"]
    return [
        ("Method", report["method"]),
        *([] if weights is None else [("Weights", weights["name"])]),
        ("Lights", str(report["n_lights"])),
        ("Pixels", f"{report['n_pixels']:,}"),
        ("Size", _SIZE.join(map(str, report["image_size"]))),
        *([] if expected is None else [("Likely within 5°", f"{expected:.0%} of the pixels")]),
        *([] if reduced is None else [("Shown at", _SIZE.join(map(str, reduced)))]),
        ("Seconds", ", ".join(f"{step} {seconds:g}" for step, seconds in report["seconds"].items())),
        ("Computed on", f"{report['device']}, {report['precision']}"),
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
    """The error map's colours from 0 to its top, as stops of a CSS gradient."""
    stops = colour_errors(np.linspace(0, TOP_DEG, 16)[None], TOP_DEG)[0]
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in stops)


def _data_url(picture: NDArray[np.uint8]) -> str:
    return f"data:image/png;base64,{base64.b64encode(encode_png(picture)).decode('ascii')}"
