"""Warnings about a capture: a stable code for programs, a sentence for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.restore.white_level import WhiteLevel
from splinecli.maths.transfer import TransferCurve


@dataclass(frozen=True)
class CaptureWarning:
    """A fault of a capture that reduces accuracy, or a decision that was made for the user.

    Args:
        code: a name that stays the same when the sentence changes; one of the constants below.
        text: one or two sentences.
    """

    code: str
    text: str

    def __str__(self) -> str:
        return self.text


AMBIENT_SUBTRACTED = "ambient_subtracted"
BLACK_PIXELS = "black_pixels"
DARK_IMAGES = "dark_images"
DIFFERENT_SIZES = "different_sizes"
DISPLAY_DECODED = "display_decoded"
DISPLAY_ENCODED = "display_encoded"
EIGHT_BIT = "eight_bit"
ENCODED_VALUES = "encoded_values"
ESTIMATED_INTENSITIES = "estimated_intensities"
ESTIMATED_LIGHTS = "estimated_lights"
EXIF_ORIENTATION = "exif_orientation"
FEW_LIGHTS = "few_lights"
GROUND_TRUTH_FRAME = "ground_truth_frame"
GROUND_TRUTH_Z = "ground_truth_z"
GROUND_TRUTH_UPSIDE_DOWN = "ground_truth_upside_down"
HIGH_LIGHTS = "high_lights"
IMAGE_ODD = "image_odd"
IMAGES_LEFT_OUT = "images_left_out"
IMAGES_SHIFTED = "images_shifted"
LIGHTS_CROWDED = "lights_crowded"
KEPT_LIGHTS = "kept_lights"
LAMPS_NEAR = "lamps_near"
LAMP_DISTANCE = "lamp_distance"
LIGHTS_MATCHED = "lights_matched"
LIGHTS_UNCHECKED = "lights_unchecked"
LIGHT_FRAME = "light_frame"
LIGHT_ORDER = "light_order"
NEAR_LAMPS = "near_lamps"
LOW_CONFIDENCE = "low_confidence"
NOT_DISTILLED = "not_distilled"
NO_MASK = "no_mask"
PROFILE_UNREAD = "profile_unread"
REPEATED_IMAGES = "repeated_images"
REFINED_LIGHTS = "refined_lights"
ROUGH_LIGHTS = "rough_lights"
SATURATED = "saturated"
UNEQUAL_INTENSITIES = "unequal_intensities"
UNTRAINED_LIGHTS = "untrained_lights"
WHITE_LEVEL = "white_level"

PROBABLY_WRONG = frozenset(
    {
        ENCODED_VALUES,
        GROUND_TRUTH_FRAME,
        GROUND_TRUTH_Z,
        IMAGE_ODD,
        IMAGES_SHIFTED,
        LAMP_DISTANCE,
        LAMPS_NEAR,
        LIGHT_FRAME,
        LIGHT_ORDER,
        LOW_CONFIDENCE,
        REPEATED_IMAGES,
    }
)
"""Warnings that say that an input is probably wrong. With --strict they are errors."""

SATURATED_SHARE = 0.01
"""The share of saturated observations above which the capture carries a warning."""

BLACK_SHARE = 0.01
"""The share of pixels without light above which the capture carries a warning."""


def white_level(level: WhiteLevel | None) -> CaptureWarning | None:
    """Warn of a white level that no file states, seen in the images."""
    if level is None or level.origin != "images":
        return None
    return CaptureWarning(
        WHITE_LEVEL,
        f"The images look clipped at {level.value:g}, so this value counts as saturated. Use --white-level N to set"
        " another value.",
    )


def saturated(share: float) -> CaptureWarning | None:
    """Warn of too large a share of saturated observations."""
    text = f"{100 * share:.1f} % of the observations are saturated; a shorter exposure gives better normals."
    return CaptureWarning(SATURATED, text) if share > SATURATED_SHARE else None


def black_pixels(share: float) -> CaptureWarning | None:
    """Warn of too large a share of pixels that no light reaches."""
    text = f"{100 * share:.1f} % of the pixels are black under every light; they get the normal (0, 0, 1)."
    warning = CaptureWarning(BLACK_PIXELS, f"{text} Leave them out with a mask or with --auto-mask.")
    return warning if share > BLACK_SHARE else None


def eight_bit() -> CaptureWarning:
    return CaptureWarning(EIGHT_BIT, "The images have 8 bits; 16-bit linear images give better normals.")


def ground_truth_upside_down() -> CaptureWarning:
    text = "The rows of the ground truth are in the wrong order; the map was turned upside down."
    return CaptureWarning(GROUND_TRUTH_UPSIDE_DOWN, text)


def estimated_intensities(intensities: NDArray[np.float64]) -> CaptureWarning:
    """Warn that light intensities (F,) with a mean of 1 were estimated."""
    return CaptureWarning(
        ESTIMATED_INTENSITIES,
        "The light intensities were estimated from the images: they are unequal, from"
        f" {intensities.min():.2f} to {intensities.max():.2f} times their mean. Use --intensities FILE if you have"
        " measured them, or --intensities equal to assume equal ones.",
    )


def estimated_lights(errors_deg: NDArray[np.float64]) -> CaptureWarning:
    """Say that the light directions were found from the images, and with which expected errors (F,) in degrees."""
    return CaptureWarning(
        ESTIMATED_LIGHTS,
        f"The light directions were estimated from the images. They are expected to be wrong by {errors_deg.mean():.0f}"
        f" degrees on average, the worst one by {errors_deg.max():.0f}; the normals turn with them.",
    )


def images_left_out(light_file: str, n_named: int, n_images: int) -> CaptureWarning:
    return CaptureWarning(
        IMAGES_LEFT_OUT, f"{light_file} names {n_named} of the {n_images} images; the others are left out."
    )


def other_pictures(names: Sequence[str]) -> CaptureWarning:
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    text = f"{names[0]}{more}: left out, because the name says that it is no photograph under one of the lights."
    return CaptureWarning(IMAGES_LEFT_OUT, f"{text} To use it, list all images in filenames.txt.")


def lights_matched(light_file: str, how: str) -> CaptureWarning:
    return CaptureWarning(LIGHTS_MATCHED, f"The lights of {light_file} were matched to the images by {how}.")


def ambient_subtracted(ambient: str) -> CaptureWarning:
    return CaptureWarning(AMBIENT_SUBTRACTED, f"{ambient} was subtracted from all images as ambient light.")


def display_decoded(by: str, curve: TransferCurve) -> CaptureWarning:
    how = "sRGB" if curve is None else "the profile says" if isinstance(curve, tuple) else f"gamma:{curve:g}"
    text = f"The images say that they are display-encoded ({by}) and are read as {how}."
    return CaptureWarning(DISPLAY_DECODED, f"{text} Add --transfer linear if their values are linear.")


def display_encoded(by: str) -> CaptureWarning:
    text = f"The images look display-encoded ({by}) but are read as linear."
    return CaptureWarning(DISPLAY_ENCODED, f"{text} Add --transfer srgb if they are sRGB.")


def profile_unread(image: str) -> CaptureWarning:
    text = f"The colour profile of {image} has no curve that can be read, so it does not count."
    return CaptureWarning(PROFILE_UNREAD, f"{text} Add --transfer linear, srgb or gamma:G.")


def exif_orientation(orientation: int) -> CaptureWarning:
    return CaptureWarning(
        EXIF_ORIENTATION,
        f"Viewers turn the images (EXIF orientation {orientation}), splinecli does not: mask, light directions and"
        " results are in the frame of the stored pixels.",
    )


def not_distilled(angle_deg: float, expected_deg: float) -> CaptureWarning:
    return CaptureWarning(
        NOT_DISTILLED,
        f"The network estimated every pixel. A small one learned from a sample, but was {angle_deg:.1f} degrees away"
        f" from it, where it expects errors of {expected_deg:.1f} degrees.",
    )


def different_sizes(n_sizes: int) -> CaptureWarning:
    return CaptureWarning(DIFFERENT_SIZES, f"The images have {n_sizes} different sizes; all images need the same size.")


def saturated_images(n_images: int, worst: str, worst_share: float) -> CaptureWarning:
    return CaptureWarning(
        SATURATED,
        f"Images saturated in more than {100 * SATURATED_SHARE:.0f} % of the pixels: {n_images}, most of all {worst}"
        f" ({100 * worst_share:.1f} %); a shorter exposure gives better normals.",
    )


def dark_images(n_images: int, example: str, share: float) -> CaptureWarning:
    return CaptureWarning(
        DARK_IMAGES,
        f"Images that use less than {100 * share:.0f} % of the range: {n_images}, such as {example};"
        " a longer exposure gives less noise.",
    )


def refined_lights(moved_deg: NDArray[np.float64], fit_ratio: float) -> CaptureWarning:
    """Say that lights were moved by these angles (F,), and what is left of the misfit."""
    return CaptureWarning(
        REFINED_LIGHTS,
        f"The light directions were refined: moved by {moved_deg.mean():.1f} degrees on average, at most"
        f" {moved_deg.max():.1f}. The images fit them better: {100 * fit_ratio:.0f} % of the misfit is left.",
    )


def kept_lights(reason: str) -> CaptureWarning:
    return CaptureWarning(KEPT_LIGHTS, f"The light directions were not refined: {reason}.")


def few_lights(n_lights: int, enough: int) -> CaptureWarning:
    return CaptureWarning(FEW_LIGHTS, f"There are {n_lights} lights; use {enough} or more, well spread.")


def high_lights(limit_deg: float) -> CaptureWarning:
    text = f"All lights are within {limit_deg:.0f} degrees of the camera axis; lower lights give better normals."
    return CaptureWarning(HIGH_LIGHTS, text)
