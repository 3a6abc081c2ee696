"""Compute the material map of a capture and its pictures, which follow the conventions of glTF."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splinecli.capture import CaptureSource
from splinecli.capture.linearise import take_pixels
from splinecli.estimate.inference import lighting_on
from splinecli.maths import Bools, Float32Array, Picture
from splinecli.maths.pixel_grid import on_map
from splinecli.maths.transfer import encode_srgb
from splinecli.records.capture_warnings import GRAY_MATERIAL, ROUGHNESS_UNDETERMINED, CaptureWarning
from splinecli.records.documents import MaterialFacts
from splinecli.results.map_values import Progress, colours_of_surface, makes

if TYPE_CHECKING:
    from splinecli.estimate.inference import NormalEstimate
    from splinecli.materials.maps import MaterialMaps


def share_picture(values: Float32Array, _: Bools) -> Picture:
    """Return values (H, W, 1) as a gray picture (H, W), where 0 is black and at least 1 is
    white.
    """
    return np.asarray(np.rint(255 * values[..., 0].clip(0, 1)), np.uint8)


def base_colour_picture(base_colour: Float32Array, _: Bools) -> Picture:
    """Return a linear base colour (H, W, 3) as an sRGB picture."""
    return encode_srgb(base_colour)


def gloss_picture(values: Float32Array, mask: Bools) -> Picture:
    """Return glTF's linear texture (H, W, 3) for roughness and metalness (H, W, 2).

    Roughness is green, and metalness blue. Red, which glTF uses for occlusion, is white in the
    mask.
    """
    return np.asarray(
        np.rint(255 * np.dstack((mask.astype(np.float32), values)).clip(0, 1)), np.uint8
    )


@makes(
    "material",
    share_picture,
    base_colour=base_colour_picture,
    roughness=share_picture,
    metalness=share_picture,
    specular=share_picture,
    material_confidence=share_picture,
    metallic_roughness=gloss_picture,
)
def material(source: CaptureSource, estimate: NormalEstimate, progress: Progress) -> Float32Array:
    """Return the material (H, W, 7) of a capture, zero outside the mask.

    The channels are base colour (3), roughness, metalness, specular reflection and confidence.
    Raises InputError if an image can no longer be read, or if there are too few lights.
    """
    normals = take_pixels(estimate.normal_map, estimate.capture.mask)
    found = material_of(estimate, colours_of_surface(source, estimate.capture, normals, progress))
    columns = (found.base_colour, found.roughness, found.metalness, found.specular)
    return on_map(np.column_stack((*columns, found.confidence)), estimate.capture.mask)


def material_of(
    estimate: NormalEstimate, colours: Iterable[Float32Array] | None = None
) -> MaterialMaps:
    """Return the material of a capture. See estimate_material for the arguments and the errors."""
    from splinecli.materials.maps import estimate_material

    capture, confidence = estimate.capture, estimate.confidence_map
    return estimate_material(
        capture.mask,
        take_pixels(estimate.normal_map, capture.mask),
        capture.light_directions,
        partial(lighting_on(capture), None),
        normal_confidence=None if confidence is None else confidence[capture.mask],
        colours=colours,
    )


_CONFIDENT, _LEAST_DETERMINED = 0.5, 0.1
"""A confidence, and the share of pixels that need it for the roughness to be determined."""


def material_facts(maps: Float32Array, mask: Bools) -> MaterialFacts:
    """Return the facts about a material for the report. In gray images, all channels are equal."""
    red, green, blue, roughness, *_, confidence = maps[mask].T
    return MaterialFacts(
        gray=bool((red == green).all() and (green == blue).all()),
        mean_confidence=round(float(confidence.mean()), 4),
        determined=round(float((confidence >= _CONFIDENT).mean()), 4),
        median_roughness=round(float(np.median(roughness)), 4),
    )


def material_warnings(facts: MaterialFacts) -> list[CaptureWarning]:
    """Return warnings about properties of a material that the images do not determine."""
    warnings = []
    if facts.gray:
        warnings.append(
            CaptureWarning(
                GRAY_MATERIAL, "The images are gray, so base_colour shows only brightness."
            )
        )
    if facts.determined < _LEAST_DETERMINED:
        warnings.append(
            CaptureWarning(
                ROUGHNESS_UNDETERMINED,
                f"The images do not determine the roughness: only {facts.determined:.1%} of the"
                f" pixels have a confidence of at least {_CONFIDENT}, because there are too few"
                " highlights or the normals are too uncertain. roughness.npy contains the most"
                f" likely values, with a median of {facts.median_roughness:.2f}. Add lights, some"
                " of them near the camera axis.",
            )
        )
    return warnings


PAGE_CAPTIONS = {
    "base_colour": "Base colour",
    "gloss": "Roughness: white is rough",
}


def page_pictures(material: Float32Array) -> dict[str, Picture]:
    """Return the pictures, named in PAGE_CAPTIONS, with which the page draws a material (H, W, 7).

    The base colour is encoded in sRGB, and so is the red channel of `gloss`, the reflectance at
    normal incidence, which is usually 4 %. Roughness (green) and metalness (blue) are linear; the
    page shows each of them as a gray picture.
    """
    from splinecli.materials.lobes import F0_OF_SPECULAR

    reflectance = encode_srgb(F0_OF_SPECULAR * material[..., 5:6])
    linear = np.rint(255 * material[..., 3:5].clip(0, 1)).astype(np.uint8)
    return {
        "base_colour": encode_srgb(material[..., :3]),
        "gloss": np.dstack((reflectance, linear)),
    }
