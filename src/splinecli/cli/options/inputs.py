"""Options of the panels Input and Lights: the files of a capture and how they are read, and the choice of lights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from splinecli.cli.options.values import NormalConvention, complete_curves

# Captures of infer and info.

Captures = Annotated[list[Path], Argument(metavar="CAPTURE", help="Folders of images, each of one object.")]
Capture = Annotated[Path, Argument(metavar="CAPTURE", help="Folder of images of one object.")]

Lights = Annotated[
    Path | None,
    Option(metavar="FILE", help="Light directions: a line x y z for each image, z to the camera."),
]
Intensities = Annotated[
    Path | None,
    Option(
        metavar="FILE|equal",
        help="Light intensities: a line r g b for each image. [default: estimated where they are unequal]",
    ),
]
Mask = Annotated[
    Path | None,
    Option(metavar="FILE", help="Mask image: non-zero pixels belong to the object. [default: all pixels]"),
]
AutoMask = Annotated[
    bool, Option("--auto-mask", help="Find the object if there is no mask, and write found_mask.png.")
]
GroundTruth = Annotated[
    Path | None, Option(metavar="FILE", help="True normals to compare with (.mat, .npy, text, PNG, TIFF).")
]
Transfer = Annotated[
    str,
    Option(
        metavar="CURVE",
        help="Transfer curve of the images: linear, srgb or gamma:G.",
        autocompletion=complete_curves,
    ),
]
Ambient = Annotated[
    Path | None,
    Option(
        metavar="FILE",
        help="Image taken without the lights, to subtract from all images. [default: ambient.*]",
    ),
]
FlatField = Annotated[
    Path | None,
    Option(metavar="DIR", help="Images of an evenly white surface: one for all lights, or one each."),
]
WhiteLevel = Annotated[
    float | None,
    Option(
        metavar="N",
        min=0,
        help="Stored value from which a pixel counts as saturated. [default: found in the images]",
    ),
]
AsStored = Annotated[
    bool,
    Option("--as-stored", help="Neither restore saturated pixels nor estimate unknown light intensities."),
]

# The files of info, whose help is shorter.

InfoLights = Annotated[
    Path | None,
    Option(metavar="FILE", help="Light directions, a line x y z for each image (z to the camera)."),
]
InfoIntensities = Annotated[
    Path | None, Option(metavar="FILE|equal", help="Light intensities, a line r g b for each image.")
]
InfoMask = Annotated[
    Path | None,
    Option(metavar="FILE", help="Mask image: non-zero pixels belong to the object. [default: all]"),
]
InfoGroundTruth = Annotated[
    Path | None, Option(metavar="FILE", help="True normals (.mat, .npy, text, PNG, TIFF).")
]

# Draws of lights, and the captures of evaluate.

Seed = Annotated[int, Option(metavar="S", min=0, max=2**32 - 1, help="Seed of the random draws.")]
NumberOfLights = Annotated[
    int | None, Option(metavar="K", help="Use K lights drawn at random. [default: all]")
]
LightIndices = Annotated[str | None, Option(metavar="I,J,...", help="Use these lights, counted from 0.")]
Datasets = Annotated[
    list[Path],
    Argument(metavar="DATASET", help="Folders of captures with ground truth, or the captures themselves."),
]
NumbersOfLights = Annotated[
    list[str] | None,
    Option(metavar="K|all", help="Number of lights in each draw. May be repeated. [default: 10]"),
]
Trials = Annotated[int | None, Option(metavar="T", min=1, help="Number of random draws. [default: 100]")]
Draws = Annotated[
    Path | None,
    Option(metavar="FILE", help="Draws of lights: each line has light indices, counted from 0."),
]
LightNoise = Annotated[
    list[float] | None,
    Option(
        metavar="SIGMA",
        min=0,
        help="Tilt the lights at random, with this standard deviation. May be repeated. [default: 0]",
    ),
]
MaxPixels = Annotated[int | None, Option(metavar="N", min=1, help="Score N random pixels of each capture.")]
SkipFirst = Annotated[
    list[str] | None,
    Option(
        metavar="[CAPTURE=]N",
        help="Leave out the first N images of one capture, or of all. May be repeated.",
    ),
]

# Targets of calibrate.

Balls = Annotated[list[Path], Argument(metavar="BALL", help="Folders of images of one mirror ball each.")]
Circles = Annotated[
    list[str] | None,
    Option(metavar="X,Y,R", help="Outline of the ball in pixels, y down. Once for each BALL."),
]
BallMasks = Annotated[
    list[Path] | None,
    Option(metavar="FILE", help="Mask image: non-zero pixels belong to the ball. Once for each BALL."),
]
GrayBall = Annotated[
    Path | None, Option(metavar="DIR", help="Images of a matte gray ball under the same lights.")
]
GrayCard = Annotated[
    Path | None, Option(metavar="DIR", help="Images of a matte gray card that faces the camera.")
]
GrayTransfer = Annotated[
    str,
    Option(
        metavar="CURVE",
        help="Transfer curve of the gray target's images: linear, srgb or gamma:G.",
        autocompletion=complete_curves,
    ),
]

# Normal maps of integrate.

Normals = Annotated[
    Path,
    Argument(metavar="NORMALS", help="Normal map (.npy, .png, .tif, .mat), or a folder that infer wrote."),
]
NormalsMask = Annotated[
    Path | None,
    Option(
        metavar="FILE",
        help="Mask image: non-zero pixels belong to the object. [default: all pixels that have a normal]",
    ),
]
CameraMatrix = Annotated[
    Path | None,
    Option(
        metavar="FILE",
        help="Text file of the 3 x 3 camera matrix in pixels, for a perspective camera."
        " [default: orthographic]",
    ),
]
NormalsConvention = Annotated[
    NormalConvention,
    Option(help="Green channel of a normal map that is an image: opengl is y up, directx is y down."),
]
Colours = Annotated[
    Path | None,
    Option(metavar="FILE", help="Image that gives the colours of the mesh, such as an albedo map."),
]
