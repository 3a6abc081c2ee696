"""Warnings about a capture: a stable code for programs, a sentence for people."""

from dataclasses import dataclass

from splinecli.maths import Doubles


@dataclass(frozen=True)
class CaptureWarning:
    """A fault of a capture that reduces accuracy, or a decision that was made for the user.

    code: a name that stays the same when the sentence changes; one of the constants below.
    error_deg: the median angle in degrees by which normals are wrong if the warning is right. The confidence falls by
        it. None if the normals are not concerned, or the confidence accounts for the fault in another way.
    """

    code: str
    text: str
    error_deg: float | None = None

    def __str__(self) -> str:
        return self.text


AMBIENT_SUBTRACTED = "ambient_subtracted"
BLACK_PIXELS = "black_pixels"
CONSTANT_LIGHT = "constant_light"
DARK_IMAGES = "dark_images"
DIFFERENT_SIZES = "different_sizes"
DISPLAY_DECODED = "display_decoded"
DISPLAY_ENCODED = "display_encoded"
EIGHT_BIT = "eight_bit"
ENCODED_VALUES = "encoded_values"
ESTIMATED_COLOURS = "estimated_colours"
ESTIMATED_INTENSITIES = "estimated_intensities"
ESTIMATED_LIGHTS = "estimated_lights"
EXIF_EXPOSURE = "exif_exposure"
EXIF_ORIENTATION = "exif_orientation"
FEW_LIGHTS = "few_lights"
GROUND_TRUTH_FRAME = "ground_truth_frame"
GROUND_TRUTH_SHIFTED = "ground_truth_shifted"
GROUND_TRUTH_Z = "ground_truth_z"
GROUND_TRUTH_UPSIDE_DOWN = "ground_truth_upside_down"
HIGH_LIGHTS = "high_lights"
IMAGE_ODD = "image_odd"
IMAGE_SCALE = "image_scale"
IMAGES_LEFT_OUT = "images_left_out"
IMAGES_SHIFTED = "images_shifted"
LIGHTS_CROWDED = "lights_crowded"
KEPT_LIGHTS = "kept_lights"
LAMPS_NEAR = "lamps_near"
LAMP_DISTANCE = "lamp_distance"
LIGHTS_MATCHED = "lights_matched"
LIGHTS_UNCHECKED = "lights_unchecked"
LIGHT_COLOURS = "light_colours"
LIGHT_FRAME = "light_frame"
LIGHT_ORDER = "light_order"
MASK_CHOICE = "mask_choice"
MASK_INVERTED = "mask_inverted"
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

PROBABLY_WRONG = frozenset({
    CONSTANT_LIGHT, ENCODED_VALUES, GROUND_TRUTH_FRAME, GROUND_TRUTH_SHIFTED, GROUND_TRUTH_Z, IMAGE_ODD, IMAGE_SCALE,
    IMAGES_SHIFTED, LAMP_DISTANCE, LAMPS_NEAR, LIGHT_COLOURS, LIGHT_FRAME, LIGHT_ORDER, LOW_CONFIDENCE, MASK_INVERTED,
    REPEATED_IMAGES, UNEQUAL_INTENSITIES,
})  # fmt: skip
"""Warnings that say that an input is probably wrong. With --strict they are errors."""

SATURATED_SHARE = 0.01  # share of saturated observations above which the capture, or an image, carries a warning


def mask_inverted(name: str) -> CaptureWarning:
    """Say that a mask is probably black on the object."""
    text = f"{name} leaves out a bright area in the middle and keeps what surrounds it: it is probably inverted."
    return CaptureWarning(MASK_INVERTED, f"{text} A mask is white on the object.")


def eight_bit(any_8_bit: bool) -> list[CaptureWarning]:
    """Warn of images with 8 bits, if there are any."""
    text = "The images have 8 bits; 16-bit linear images give better normals."
    return [CaptureWarning(EIGHT_BIT, text)] if any_8_bit else []


def estimated_lights(errors_deg: Doubles) -> CaptureWarning:
    """Say that the light directions were found from the images, and with which expected errors (F,) in degrees."""
    return CaptureWarning(
        ESTIMATED_LIGHTS,
        f"The light directions were estimated from the images. They are expected to be wrong by {errors_deg.mean():.0f}"
        f" degrees on average, the worst one by {errors_deg.max():.0f}; the normals turn with them.",
    )
