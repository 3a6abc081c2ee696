"""Options that several commands have. A command declares its other options in its signature."""

from typer import Option

from splinecli.cli.values import Device, LightForm, Precision, complete_curves, complete_list, complete_weights

MASK_IMAGE = "Mask image, white on the {} (above half of its largest value)."
STIFFNESS = "How easily the surface of integrate or --surface tears at edges: more with a larger number, never with 0."
PIXEL_SIZE = "Near lamps: the width of a pixel on the object. [default: pixel_size.txt in CAPTURE]"

# Input and lights.

LIGHTS = Option(
    None,
    metavar="FILE|estimate",
    help="Light directions: a line x y z for each image, z to the camera. estimate finds them from the images, less"
    " exactly. [default: the light file in CAPTURE]",
)
FIRST_LIGHT = Option(
    None,
    help="With --lights estimate: side from which the light of the first image that is used comes. Objects without"
    " outline need it.",
)
LIGHT_FRAME = Option(
    None,
    metavar="LIST",
    help="Frame of the light file: any of x-left, y-down, z-away and exchanged (y stands before x)."
    " [default: x right, y up, z to the camera]",
    autocompletion=complete_list(["x-left", "y-down", "z-away", "exchanged"]),
)
LIGHTS_FORMAT = Option(
    LightForm.xyz,
    help="Numbers of a light in a text file: a vector x y z; azel, azimuth and elevation; or slant-tilt, the angles"
    " of HALCON. Angles are in degrees.",
)
INTENSITIES = Option(
    None,
    metavar="FILE|equal",
    help="Light intensities: a line r g b for each image. [default: equal, or estimated if the images show that"
    " they differ]",
)
REFINE_LIGHTS = Option(
    False, "--refine-lights", help="Refine rough light directions so that they fit the images better."
)
LIGHT_POSITIONS = Option(
    None,
    metavar="FILE",
    help="Near lamps: a line x y z for each image, in any unit, from the middle of the image."
    " [default: light_positions.txt in CAPTURE]",
)
LIGHT_DISTANCE = Option(None, metavar="D", help="Near lamps: the distance of all lamps from the middle of the object.")
OBJECT_WIDTH = Option(
    None, metavar="W", help="Near lamps: the width of the object in its mask, in place of --pixel-size."
)
CAMERA_MATRIX = Option(
    None,
    metavar="FILE",
    help="Near lamps: the camera matrix in pixels. [default: camera_matrix.txt in CAPTURE, or orthographic]",
)
MASK = Option(None, metavar="FILE", help=f"{MASK_IMAGE.format('object')} [default: a file named mask.*, or all pixels]")
CROP = Option(None, metavar="X,Y,W,H", help="Read this box of the images: left upper corner and size in pixels.")
SCALE = Option(None, metavar="1/N", help="Read every N-th row and column, for a first look. [default: all]")
GROUND_TRUTH = Option(None, metavar="FILE", help="True normals to compare with (.mat, .npy, text, PNG, TIFF).")
TRANSFER = Option(
    "auto",
    metavar="CURVE",
    help="Transfer curve of the images: auto, linear, srgb or gamma:G. auto reads files as they say; JPEG as sRGB.",
    autocompletion=complete_curves,
)
AMBIENT = Option(
    None, metavar="FILE", help="Image taken without the lights, to subtract from all images. [default: ambient.*]"
)
FLAT_FIELD = Option(
    None,
    metavar="DIR",
    help="Folder with images of an evenly white surface: one for all lights, or one for each light.",
)
WHITE_LEVEL = Option(
    None, metavar="N", min=0, help="Stored value from which a pixel counts as saturated. [default: found in the images]"
)
AS_STORED = Option(
    False, "--as-stored", help="Use the stored values: do not restore saturated pixels or estimate light intensities."
)
SEED = Option(0, metavar="S", min=0, max=2**32 - 1, help="Seed of the random draws.")

# Method and speed.

WEIGHTS = Option(
    None,
    metavar="NAME|FILE",
    help="Weights: a shipped name or a file. [default: those of the method]",
    autocompletion=complete_weights,
)
DEVICE = Option(Device.auto, help="Device to compute on. auto is a CUDA GPU if there is one, else the CPU.")
PRECISION = Option(Precision.auto, help="Number format. auto is bfloat16 if the hardware supports it, else float32.")

# Output.

OVERWRITE = Option(False, "--overwrite", help="Replace earlier results.")
UPDATE = Option(False, "--update", help="Compute changed captures again, and skip those that are done.")
STRICT = Option(
    False, "--strict", help="Fail (exit code 3) where a warning says that the lights or the images are probably wrong."
)
JSON = Option(False, "--json", help="Print one JSON document on stdout, and nothing else.")
QUIET = Option(False, "--quiet", "-q", help="Print nothing but errors.")
