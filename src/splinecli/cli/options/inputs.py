"""Options of the panels Input and Lights: the files of a capture and how they are read, and the choice of lights."""

from __future__ import annotations

from typer import Argument, Option

from splinecli.cli.options.values import LightForm, complete_curves, complete_list

MASK_IMAGE = "Mask image, white on the {} (above half of its largest value)."

# Captures of infer and info.

CAPTURES = Argument(..., metavar="CAPTURE", help="Folders with the images of one object each, or films.")
CAPTURE = Argument(..., metavar="CAPTURE", help="Folder with the images of one object, or a film.")

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
ESTIMATED_LIGHTS = Option(
    None,
    "--lights",
    metavar="estimate",
    help="Estimate the lights of each draw from its images, and score them, too. [default: the captures' light files]",
)
LIGHT_FRAME = Option(
    None,
    metavar="LIST",
    help="Frame of the light file: any of x-left, y-down, z-away and exchanged (y stands before x)."
    " [default: x right, y up, z to the camera]",
    autocompletion=complete_list("x-left", "y-down", "z-away", "exchanged"),
)
CHECK_LIGHTS = Option(
    False, "--check-lights", help="List other readings of the light file, and how well the images fit each."
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
LIGHT_ERROR = Option(
    None, metavar="SIGMA", help="With --refine-lights: usual error of the directions in degrees. [default: 5]"
)
LIGHT_POSITIONS = Option(
    None,
    metavar="FILE",
    help="Near lamps: a line x y z for each image, in any unit, from the middle of the image."
    " [default: light_positions.txt in CAPTURE]",
)
LIGHT_DISTANCE = Option(None, metavar="D", help="Near lamps: the distance of all lamps from the middle of the object.")
_PIXEL_SIZE = "Near lamps: the width of a pixel on the object. [default: pixel_size.txt in CAPTURE]"
PIXEL_SIZE = Option(None, metavar="S", help=_PIXEL_SIZE)
PIXEL_SIZE_OF_SURFACE = Option(
    None,
    "--pixel-size",
    metavar="S",
    help=f"{_PIXEL_SIZE} With --surface: in millimetres, for a surface in millimetres.",
)
PIXEL_SIZE_MM = Option(
    None,
    "--pixel-size",
    metavar="MM",
    help="Width of a pixel of the photographs on the object in millimetres, for a surface in millimetres. [default: as"
    " in report.json beside the normal map, or in pixels]",
)
OBJECT_WIDTH = Option(
    None, metavar="W", help="Near lamps: the width of the object in its mask, in place of --pixel-size."
)
LAMP_CAMERA_MATRIX = Option(
    None,
    metavar="FILE",
    help="Near lamps: the camera matrix in pixels. [default: camera_matrix.txt in CAPTURE, or orthographic]",
)
MASK = Option(
    None,
    metavar="FILE",
    help=f"{MASK_IMAGE.format('object')} [default: a file named mask.*, or all pixels]",
)
AUTO_MASK = Option(
    False, "--auto-mask", help="If there is no mask, find the object in the images and write found_mask.png."
)
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
    None,
    metavar="FILE",
    help="Image taken without the lights, to subtract from all images. [default: ambient.*]",
)
FLAT_FIELD = Option(
    None,
    metavar="DIR",
    help="Folder with images of an evenly white surface: one for all lights, or one for each light.",
)
WHITE_LEVEL = Option(
    None,
    metavar="N",
    min=0,
    help="Stored value from which a pixel counts as saturated. [default: found in the images]",
)
AS_STORED = Option(
    False,
    "--as-stored",
    help="Use the stored values: do not restore saturated pixels or estimate light intensities.",
)

# Draws of lights, and the captures of evaluate.

SEED = Option(0, metavar="S", min=0, max=2**32 - 1, help="Seed of the random draws.")
NUMBER_OF_LIGHTS = Option(None, metavar="K", help="Use K lights drawn at random. [default: all]")
LIGHT_INDICES = Option(
    None, metavar="I,J,...", help="Use these lights, counted from 0. Plots and warnings count from 1."
)
DATASETS = Argument(..., metavar="DATASET", help="Folders of captures with ground truth, or the captures themselves.")
NUMBERS_OF_LIGHTS = Option(None, metavar="K|all", help="Number of lights in each draw. May be repeated. [default: 10]")
TRIALS = Option(None, metavar="T", min=1, help="Number of random draws. [default: 100]")
DRAWS = Option(None, metavar="FILE", help="Draws of lights: each line has light indices, counted from 0.")
LIGHT_NOISE = Option(
    None,
    metavar="SIGMA",
    min=0,
    help="Tilt the lights at random, with this standard deviation in degrees. May be repeated. [default: 0]",
)
MAX_PIXELS = Option(None, metavar="N", min=1, help="Score N random pixels of each capture. [default: all]")
SKIP_FIRST = Option(
    None,
    metavar="[CAPTURE=]N",
    help="Leave out the first N images of one capture, or of all. May be repeated. [default: 0]",
)

# Targets of calibrate.

BALLS = Argument(..., metavar="BALL", help="Folders of images of one mirror ball each.")
CIRCLES = Option(
    None, metavar="X,Y,R", help="Outline of the ball in pixels, y down. May be repeated, once for each BALL."
)
BALL_MASKS = Option(
    None,
    metavar="FILE",
    help=f"{MASK_IMAGE.format('ball')} May be repeated, once for each BALL.",
)
BALL_DIAMETER = Option(
    None,
    metavar="D",
    help="Diameter of each ball in any unit, such as millimeters: the unit of the lamps' positions. [default: pixels]",
)
BALL_CAMERA_MATRIX = Option(
    None,
    "--camera-matrix",
    metavar="FILE",
    help="Text file of the 3 x 3 camera matrix in pixels. [default: focal length from EXIF, or a distant camera]",
)
GRAY_BALL = Option(None, metavar="DIR", help="Images of a matte gray ball under the same lights.")
GRAY_CARD = Option(None, metavar="DIR", help="Images of a matte gray card that faces the camera.")
GRAY_TRANSFER = Option(
    "auto",
    metavar="CURVE",
    help="Transfer curve of the gray target's images: auto, linear, srgb or gamma:G.",
    autocompletion=complete_curves,
)

# Normal maps of integrate.

NORMALS = Argument(..., metavar="NORMALS", help="Normal map (.npy, .png, .tif, .mat), or a folder that infer wrote.")
NORMALS_MASK = Option(
    None,
    metavar="FILE",
    help=f"{MASK_IMAGE.format('object')} [default: all pixels that have a normal]",
)
CAMERA_MATRIX = Option(
    None,
    metavar="FILE",
    help="Text file of the 3 x 3 camera matrix in pixels, for a perspective camera. [default: as in report.json beside"
    " the normal map, or orthographic]",
)
NORMALS_CONVENTION = Option(
    None,
    help="Green channel of a normal map of colours: opengl is y up, directx is y down. [default: as in report.json"
    " beside it, or opengl]",
)
PRIOR = Option(
    None,
    metavar="FILE",
    help="Depth map of the same view from elsewhere, such as a scan: the surface has its shape in the large, and the"
    " detail of the normals. .npy, .tif or .exr, with heights towards the camera in the unit of the result, or with"
    " depths in millimetres for a perspective camera. NaN is unknown.",
)
COLOURS = Option(
    None,
    metavar="FILE",
    help="Image of the object's colours, for the mesh. [default: albedo.png beside NORMALS, if NORMALS is a folder]",
)
