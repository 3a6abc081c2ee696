"""`splinecli calibrate` and `integrate`: images of balls -> lights, a normal map -> depth map and mesh."""

from pathlib import Path

from typer import Argument, Option

from splinecli.cli import shared
from splinecli.cli.console import Messages, print_report
from splinecli.surface.surface_files import DEFAULT_FORMATS, SURFACE_FILES


def calibrate(
    balls: list[Path] = Argument(..., metavar="BALL", help="Folders of images of one mirror ball each."),
    circle: list[str] | None = Option(
        None, metavar="X,Y,R", help="Outline of the ball in pixels, y down. May be repeated, once for each BALL."
    ),
    mask: list[Path] | None = Option(
        None, metavar="FILE", help=f"{shared.MASK_IMAGE.format('ball')} May be repeated, once for each BALL."
    ),
    ball_diameter: float | None = Option(
        None,
        metavar="D",
        help="Diameter of each ball in any unit, such as millimeters: the unit of the lamps' positions."
        " [default: pixels]",
    ),
    camera_matrix: Path | None = Option(
        None,
        metavar="FILE",
        help="Text file of the 3 x 3 camera matrix in pixels. [default: focal length from EXIF, or a distant camera]",
    ),
    gray_ball: Path | None = Option(None, metavar="DIR", help="Images of a matte gray ball under the same lights."),
    gray_card: Path | None = Option(None, metavar="DIR", help="Images of a matte gray card that faces the camera."),
    transfer: str = Option(
        "auto",
        metavar="CURVE",
        help="Transfer curve of the gray target's images: auto, linear, srgb or gamma:G.",
        autocompletion=shared.complete_curves,
    ),
    compare: Path | None = Option(
        None, metavar="FILE", help="Compare the result with the light directions in a text file."
    ),
    output: Path = Option(Path("calibration"), "--output", "-o", metavar="OUT", help="Folder of the results."),
    overwrite: bool = shared.OVERWRITE,
    as_json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
) -> None:
    """Measure light directions from images of mirror balls.

    A BALL is a folder with one image for each light, in the order of the lights. The outline of the ball comes from
    --circle or a mask (--mask, or a file named mask in the folder). Otherwise it is detected in an image named ref, or
    in the mean of all images. The brightest spot in the ball is the lamp. Directions of several balls are averaged.

    Writes OUT/light_directions.txt for the option --lights of infer, calibration.png to check the result by eye, and
    calibration.json. With a gray ball or card, it also writes light_intensities.txt, the relative light intensities.
    With two balls or more, or one ball at two places, lamps that are near and a known camera, it also writes
    light_positions.txt, pixel_size.txt and camera_matrix.txt for --light-positions of infer.
    """
    given = locals()

    from splinecli.pipeline.calibrate import DIRECTIONS, CalibrateOptions, calibrate_lights

    circles = tuple(shared.parse_circle(text) for text in circle or ())
    options = shared.record_from(CalibrateOptions, given, circles=circles, masks=tuple(mask or ()))
    report = calibrate_lights(options, Messages(quiet=quiet))
    print_report(report, str(output / DIRECTIONS), as_json=as_json, quiet=quiet)


def integrate(
    normals: Path = Argument(
        ..., metavar="NORMALS", help="Normal map (.npy, .png, .tif, .mat), or a folder that infer wrote."
    ),
    mask: Path | None = Option(
        None, metavar="FILE", help=f"{shared.MASK_IMAGE.format('object')} [default: all pixels that have a normal]"
    ),
    camera_matrix: Path | None = Option(
        None,
        metavar="FILE",
        help="Text file of the 3 x 3 camera matrix in pixels, for a perspective camera. [default: as in report.json"
        " beside the normal map, or orthographic]",
    ),
    convention: shared.NormalConvention | None = Option(
        None,
        help="Green channel of a normal map of colours: opengl is y up, directx is y down. [default: as in report.json"
        " beside it, or opengl]",
    ),
    colours: Path | None = Option(
        None,
        metavar="FILE",
        help="Image of the object's colours, for the mesh."
        " [default: albedo.png beside NORMALS, if NORMALS is a folder]",
    ),
    stiffness: float | None = Option(
        None, metavar="K", min=0, help=f"{shared.STIFFNESS} [default: as in report.json beside the normal map, or 2]"
    ),
    prior: Path | None = Option(
        None,
        metavar="FILE",
        help="Depth map of the same view from elsewhere, such as a scan: the surface has its shape in the large, and"
        " the detail of the normals. .npy, .tif or .exr, with heights towards the camera in the unit of the result, or"
        " with depths in millimetres for a perspective camera. NaN is unknown.",
    ),
    prior_detail: float | None = Option(
        None,
        metavar="PIXELS",
        min=1,
        help="With --prior: shapes narrower than this come from the normals. [default: 15 % of the object's size]",
    ),
    largest_step: float | None = Option(
        None,
        metavar="PIXELS",
        min=0,
        help="Leave out triangles whose corners differ by more than this height. [default: keep all]",
    ),
    pixel_size: float | None = Option(
        None,
        metavar="MM",
        help="Width of a pixel of the photographs on the object in millimetres, for a surface in millimetres."
        " [default: that of infer --surface, by report.json beside the normal map, or in pixels]",
    ),
    output: Path | None = Option(
        None, "--output", "-o", metavar="OUT", help="Folder of the results. [default: that of NORMALS]"
    ),
    formats: str = Option(
        ",".join(DEFAULT_FORMATS),
        "--format",
        metavar="LIST",
        help=f"Files to write, any of {', '.join(SURFACE_FILES)}: meshes, and depth maps in float32 or"
        " as a 16-bit picture (png). exr needs the extra 'exr'.",
        autocompletion=shared.complete_list(SURFACE_FILES),
    ),
    decimate: int | None = Option(
        None,
        metavar="N",
        help="Reduce the mesh to N triangles; a texture of the normals keeps the detail in GLB (needs the extra"
        " 'mesh'). [default: all]",
    ),
    overwrite: bool = shared.OVERWRITE,
    as_json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
) -> None:
    """Integrate a normal map to a depth map and a mesh.

    Uses bilateral normal integration. The surface may break at edges, where the normals do not fit together. Without a
    camera matrix, the depth map has heights towards the camera in pixels, with mean zero. With one, it has depths
    along the viewing axis, of unknown scale.

    Writes OUT/mesh.glb and mesh.ply (or .obj, .stl), depth.npy and depth.tiff, which are NaN outside the object,
    depth.png and surface.json.
    """
    given = locals()

    from splinecli.pipeline.integrate import IntegrateOptions, integrate_normal_map, summary_line

    files = shared.split_commas(formats, "--format", SURFACE_FILES)
    options = shared.record_from(IntegrateOptions, given, formats=files)
    report = integrate_normal_map(options, Messages(quiet=quiet))
    print_report(report, summary_line(options, report), as_json=as_json, quiet=quiet)
