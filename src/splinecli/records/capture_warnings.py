"""The kinds of warnings about a capture, one per row, each with a stable code for programs.

Checks and readers create warnings from these rows, each with a human-readable sentence. The table
in docs/warnings.md is generated from the rows (docs/make_tables.py), which also determine the
warnings that `--strict` turns into errors.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

from splinecli.maths import Float64Array


@dataclass(frozen=True)
class WarningKind:
    """A kind of warning.

    code: a name that stays the same even if the messages are reworded. meaning, remedy: for the
    documentation, in Markdown. severity: "error" means that an input is probably wrong; with
    --strict, the warning becomes an error.
    """

    code: str
    meaning: str
    remedy: str = "none"
    severity: Literal["note", "error"] = "note"

    @property
    def is_error(self) -> bool:
        return self.severity == "error"


@dataclass(frozen=True)
class CaptureWarning:
    """A fault of a capture that reduces accuracy, or a decision that was made for the user.

    error_deg: the median angular error of the normals in degrees if the warning is correct. The
        confidence is lowered accordingly. None if the normals are not affected, or the confidence
        accounts for the fault in another way.
    again: a shorter text for later captures of a batch, with the facts that differ between
        captures. Empty if the whole text is repeated.
    """

    kind: WarningKind
    text: str
    error_deg: float | None = None
    again: str = ""

    @property
    def code(self) -> str:
        return self.kind.code

    @property
    def is_error(self) -> bool:
        return self.kind.is_error

    def __str__(self) -> str:
        return self.text


fault = partial(WarningKind, severity="error")

# Each row has a code, a meaning and a remedy. A fault means that an input is probably wrong.
AMBIENT_SUBTRACTED = WarningKind(
    "ambient_subtracted", "The image `ambient.*` in the folder was subtracted"
)
BLACK_PIXELS = WarningKind(
    "black_pixels",
    "Over 1 % of the pixels are black under every light",
    "Use a mask, or a longer exposure",
)
CONSTANT_LIGHT = fault(
    "constant_light",
    "The images seem to contain [ambient"
    " light](input-checks.md#other-interpretations-of-the-images) or a black level",
    "`--ambient IMAGE`, taken with all lamps off",
)
CURVE_MENDED = WarningKind(
    "curve_mended",
    "The images were clearly [encoded](input-checks.md#other-interpretations-of-the-images),"
    " although their files do not specify a curve, so they were decoded",
    "`--transfer linear` if they are linear",
)
DARK_IMAGES = WarningKind(
    "dark_images",
    "Some images use less than 5 % of the range, or less than 25 % with 8 bits",
    "Use a longer exposure",
)
DISPLAY_DECODED = WarningKind(
    "display_decoded",
    "The image files specify a transfer curve, as JPEG files do, and are read with it",
    "`--transfer linear` if they are linear",
)
DISPLAY_ENCODED = WarningKind(
    "display_encoded",
    "Some images are JPEG or sRGB files, but are read as linear",
    "`--transfer srgb`; none if they are linear",
)
EIGHT_BIT = WarningKind(
    "eight_bit",
    "The images have 8 bits; the message states the [loss of accuracy](robustness.md#8-bits)",
    "Export 16-bit linear images, or use RAW; round to 8 bits instead of truncating",
)
ELEVATION_SUSPECTED = fault(
    "elevation_suspected",
    "The images would fit the lights much better if all of them were higher or lower",
    "Correct the elevations in the light file, or use `info --mended-lights`",
)
ESTIMATED_COLOURS = WarningKind(
    "estimated_colours",
    "The lamps have different colours, which were estimated and divided out",
    "RGB intensities with `--intensities FILE` if you have measured them",
)
ESTIMATED_INTENSITIES = WarningKind(
    "estimated_intensities",
    "Light intensities were [estimated](image-preparation.md#estimated-light-intensities)",
    "`--intensities FILE` if you have measured them",
)
ESTIMATED_LIGHTS = WarningKind(
    "estimated_lights",
    "The light directions were [estimated from the images](unknown-lights.md)",
    "Measure the lights if the expected error is too large",
)
EXIF_EXPOSURE = WarningKind(
    "exif_exposure",
    "The exposures in EXIF differ, so the images were divided by them",
    "Expose all images alike, with exposure and white balance fixed",
)
EXIF_ORIENTATION = WarningKind(
    "exif_orientation",
    "An EXIF tag rotates the images in viewers; splinecli uses the stored pixels",
    "Make the mask and the lights fit the stored pixels",
)
FEW_LIGHTS = WarningKind("few_lights", "There are fewer than eight lights", "Add lights")
FLAT_FIELD_CHOICE = WarningKind(
    "flat_field_choice",
    "With `--lights-in-channels`: a picture of the sensor without contact is used as the flat"
    " field",
    "`--flat-field DIR` for another one",
)
GRAY_MATERIAL = WarningKind(
    "gray_material", "With `--maps material`: gray images have no base colour, only brightness"
)
GROUND_TRUTH_FRAME = fault(
    "ground_truth_frame",
    "The ground truth fits the images only if x or y is negated, or x and y are exchanged",
    "Convert it to x right, y up, z to the camera; if the lights are wrong, use `--light-frame`",
)
GROUND_TRUTH_SHIFTED = fault(
    "ground_truth_shifted",
    "The ground truth fits the images only after a shift",
    "Align both; the images may have moved",
)
GROUND_TRUTH_UPSIDE_DOWN = WarningKind(
    "ground_truth_upside_down", "The ground truth was upside down and was flipped"
)
GROUND_TRUTH_Z = fault(
    "ground_truth_z", "The ground truth points away from the camera", "Negate its z"
)
IMAGE_INCONSISTENT = fault(
    "image_inconsistent",
    "One image [contradicts the others](input-checks.md#one-odd-image)",
    "Photograph it again, or leave it out with `--light-indices`",
)
IMAGE_SCALE = fault(
    "image_scale",
    "One image is 16, 64 or 256 times darker or brighter than the others predict, like a"
    " 12-bit image among 16-bit ones",
    "Save all images with the same bit depth",
)
IMAGES_ALIGNED = WarningKind(
    "images_aligned",
    "The images were [aligned](image-preparation.md#moved-images), as `--align` requests or because"
    " they clearly moved",
    "`--as-stored` keeps them in place",
)
IMAGES_LEFT_OUT = WarningKind(
    "images_left_out",
    "The light file does not list all images, or some pictures are named like a mask or a map, or"
    " have another size",
    "Check names and sizes",
)
IMAGES_SHIFTED = fault(
    "images_shifted",
    "Images are [shifted relative to the others](input-checks.md#shifted-images)",
    "[`--align`](image-preparation.md#moved-images); next time, photograph from a tripod",
)
LAMP_DISTANCE = fault(
    "lamp_distance",
    "A lamp is nearer than the object is wide, or hundreds of widths away",
    "Use the same unit for the lamps and the pixel size",
)
LIGHT_COLOURS = fault(
    "light_colours",
    "The lamps have different colours, and some lack a channel, so the colours cannot be divided"
    " out",
    "Use white lamps, or measure RGB intensities",
)
LIGHT_FRAME = fault(
    "light_frame",
    "The lights are probably in [another frame](input-checks.md#wrong-light-directions), rotated,"
    " or half vectors",
    "`--light-frame` or `info --mended-lights`, as the warning says",
)
LIGHT_ORDER = fault(
    "light_order",
    "The order of the lights probably differs from that of the images",
    "Correct the light file",
)
LIGHTS_CONTRADICTED = fault(
    "lights_contradicted",
    "The images clearly fit [other lights](input-checks.md#wrong-light-directions) better than the"
    " given ones",
    "Check their frame, order and elevations, or use `info --mended-lights`",
)
LIGHTS_FOUND = WarningKind(
    "lights_found",
    "The light directions were read from a file with an unusual name or place, or from the [names"
    " of the images](light-files.md#lights-in-other-places)",
    "`--lights FILE` for another file",
)
LIGHTS_ILL_CONDITIONED = WarningKind(
    "lights_ill_conditioned",
    "The lights determine the normals poorly",
    "Add lights from other sides",
)
LIGHTS_IN_CHANNELS = WarningKind(
    "lights_in_channels",
    "The channels are read as images under three lamps, as `--lights-in-channels` requests;"
    " coloured objects get wrong normals",
    "Use a [crosstalk matrix](coloured-lights.md), and gray objects",
)
LIGHTS_MATCHED = WarningKind(
    "lights_matched",
    "Lights were matched to images by a rule other than the full name",
    "Check the order of the lights",
)
LIGHTS_MENDED = WarningKind(
    "lights_mended",
    "The light directions clearly [contradicted the images](input-checks.md#wrong-light-directions)"
    " and were corrected; `infer` writes them to `mended_lights.txt`",
    "`--light-frame x-right,y-up` uses the file as it is",
)
LIGHTS_NEAR_AXIS = WarningKind(
    "lights_near_axis", "All lights are close to the camera axis", "Add lower lights"
)
LIGHTS_UNCHECKED = WarningKind(
    "lights_unchecked",
    "Shadows that the lights should cast are missing; with `--strict`, also if the order, the"
    " frame or the elevation of the lights [cannot be"
    " checked](input-checks.md#wrong-light-directions)",
    "Compare bumps and hollows with the object",
)
LIGHTS_TILTED = fault(
    "lights_tilted",
    "All lights are probably [tilted together](input-checks.md#wrong-light-directions)",
    "Measure them in the frame of the camera; without `--as-stored` and `--light-frame`, `infer`"
    " corrects them",
)
LIGHTS_UNCERTAIN = WarningKind(
    "lights_uncertain",
    "The network predicts smaller errors under [other"
    " lights](input-checks.md#wrong-light-directions), so the confidence is lowered",
    "Check the lights; none for unusual materials",
)
LOW_CONFIDENCE = fault(
    "low_confidence",
    "The network predicts large errors for nearly all normals",
    "Check the lights, the mask and the images",
)
MASK_CHOICE = WarningKind(
    "mask_choice",
    "Without a `mask.*`, a picture with the word `mask` in its name, or the alpha channel of the"
    " images, is used as the mask; if there are several such pictures, they are ignored",
    "`--mask FILE` for another one",
)
MASK_INVERTED = fault(
    "mask_inverted",
    "The mask excludes a bright area in the middle",
    "Invert it, so that the object is white",
)
NEAR_LAMPS = WarningKind(
    "near_lamps",
    "The folder contains lamp positions, or vectors look like positions, but the lights are"
    " treated as distant",
    "`--light-positions FILE`, or leave `--lights` out",
)
NEAR_LIGHTS_SUSPECTED = fault(
    "near_lights_suspected",
    "The images fit [near lamps](input-checks.md#other-interpretations-of-the-images) much better",
    "[Specify their positions](near-lamps.md)",
)
NO_MASK = WarningKind(
    "no_mask",
    "There is no mask that excludes pixels, and most pixels are nearly black",
    "`--auto-mask`, or a mask",
)
NONLINEARITY_SUSPECTED = fault(
    "nonlinearity_suspected",
    "The images [look encoded](input-checks.md#other-interpretations-of-the-images), but are read"
    " as linear",
    "`--transfer srgb` or `gamma:2.2`",
)
NOT_DISTILLED = WarningKind(
    "not_distilled",
    "A small network did not approximate the full one well enough on this large capture, so the"
    " computation took longer",
    "none; `--method iw12` is faster",
)
PROFILE_UNREAD = WarningKind(
    "profile_unread",
    "The transfer curve in a colour profile cannot be read",
    "`--transfer linear`, `srgb` or `gamma:G`",
)
REFINED_LIGHTS = WarningKind(
    "refined_lights",
    "`--refine-lights` moved the light directions",
    "Compare them with the given directions",
)
REFINEMENT_REJECTED = WarningKind(
    "refinement_rejected", "`--refine-lights` found no better directions"
)
REPEATED_IMAGES = fault(
    "repeated_images", "Two images are identical, but their lights differ", "Replace one of them"
)
ROUGH_LIGHTS = WarningKind(
    "rough_lights",
    "Refined light directions would fit the images much better than the given ones",
    "[`--refine-lights`](infer.md#rough-directions), or measure them again",
)
ROUGHNESS_UNDETERMINED = WarningKind(
    "roughness_undetermined",
    "With `--maps material`: there are too few highlights, or the normals are too uncertain, to"
    " [determine the roughness](materials.md#limits)",
    "Add lights, some of them near the camera axis",
)
SETTINGS_READ = WarningKind(
    "settings_read",
    "The file `splinecli.toml` in the folder sets options for reading the capture",
    "Options on the command line take precedence",
)
SATURATED = WarningKind(
    "saturated", "Over 1 % of the observations are saturated", "Use a shorter exposure"
)
SOFT_IMAGES = fault(
    "soft_images",
    "The outline and all shadows are [blurred](image-preparation.md#lens-blur) by 2 pixels or more",
    "Photograph the object again, in focus",
)
UNDECIDED = WarningKind(
    "reading_undecided",
    "Other explanations, such as near lamps, [remain possible](input-checks.md), so the confidence"
    " is lowered",
    "Check how the capture was made, or add lights from other sides",
)
UNEQUAL_INTENSITIES = fault(
    "unequal_intensities",
    "The light intensities seem unequal, but the images do not determine them; or given"
    " intensities do not fit the images",
    "[Measure them](capture-and-calibrate.md#light-intensities), or correct the file",
)
UNKNOWN_MATERIAL = WarningKind(
    "unknown_material",
    "The object looks translucent, which flattens the normals with every method",
    "Coat the object with a matte spray or powder, if it may be coated",
)
UNTRAINED_LIGHTS = WarningKind(
    "untrained_lights",
    "The weights were not trained with this number of lights",
    "`--n-lights`, other weights, or `--method spline-net`",
)
WHITE_LEVEL = WarningKind(
    "white_level",
    "The images look clipped below full scale, or all values of 16-bit files fit in 10 or 12 bits",
    "`--white-level N` sets another value",
)

WARNINGS = {kind.code: kind for kind in list(globals().values()) if isinstance(kind, WarningKind)}
# faults of the light directions, which are corrected if they are clear
FAULTS_OF_LIGHTS = frozenset(
    {ELEVATION_SUSPECTED, LIGHT_FRAME, LIGHT_ORDER, LIGHTS_CONTRADICTED, LIGHTS_TILTED}
)
PROBABLY_WRONG = frozenset(code for code, kind in WARNINGS.items() if kind.is_error)
# median error of the normals, in degrees, from a blur of 2 to 4 pixels
SOFT_DEG = 5.5
# share of saturated observations above which a warning is given
SATURATED_SHARE = 0.01


def mask_inverted(name: str) -> CaptureWarning:
    """Return the warning that a mask is probably black on the object."""
    text = (
        f"{name} excludes a bright area in the middle and keeps its surroundings, so it is"
        " probably inverted."
    )
    return CaptureWarning(MASK_INVERTED, f"{text} Invert it, so that the object is white.")


def soft_images() -> CaptureWarning:
    """Return the warning that the images are too blurred to be sharpened."""
    text = (
        "The images are blurred: no edge of a shadow, and no part of the outline, is sharper than"
        " about 2 pixels. Sharpening cannot undo this, so photograph the object again, in focus and"
        " with a smaller aperture."
    )
    return CaptureWarning(SOFT_IMAGES, text, SOFT_DEG)


def lights_mended(cause: str, *, in_files: bool = True) -> CaptureWarning:
    """Return the note that the light directions were corrected. `cause` is a sentence."""
    option = "--light-frame x-right,y-up" if in_files else "as_stored=True"
    text = f"{cause} They were corrected; {option} keeps them as given."
    return CaptureWarning(LIGHTS_MENDED, text)


def estimated_lights(errors_deg: Float64Array, *, requested: bool) -> CaptureWarning:
    """Return the note that the light directions were estimated, with expected errors (F,) in
    degrees.

    They are estimated because this was requested, or because there is no light file.
    """
    why, way_out = "", ""
    if not requested:
        why = ", because the capture has no light file"
        way_out = " If you have measured the lights, add --lights FILE."
    expected = (
        f"Their expected error is {errors_deg.mean():.1f} degrees on average and"
        f" {errors_deg.max():.1f} degrees for the worst one"
    )
    return CaptureWarning(
        ESTIMATED_LIGHTS,
        f"The light directions were estimated from the images{why}. {expected}; the normals inherit"
        f" these errors.{way_out}",
        again=f"The light directions were estimated. {expected}.",
    )
