"""The files that splinecli writes, with one row of MAPS for each optional map.

A row defines how its map is computed, written, read, drawn and shown, how much memory it needs, and
its file names, which are not read as photographs. results/map_values.py registers the functions
that compute and draw the maps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splinecli.errors import InputError

NORMALS = {
    "png": "normals.png",
    "png8": "normals_8bit.png",
    "npy": "normals.npy",
    "tiff": "normals.tiff",
    "exr": "normals.exr",
}
"""The file of the normal map in each format."""

ERROR_MAP, GLOSS = "error_map.png", "metallic_roughness.png"
REPORT, PAGE, FOUND_MASK = "report.json", "page.html", "found_mask.png"
MENDED_LIGHTS = "mended_lights.txt"  # corrected light directions
CAPTURE_SHEET = "capture.png"  # contact sheet of the capture's files; also written by `info`
# Lights estimated by `infer`. If results and capture share a folder, the user's own files may have
# these names.
FOUND_LIGHTS = ("light_directions.txt", "light_intensities.txt", "lights.png")
FOUND_DIRECTIONS, FOUND_INTENSITIES, LIGHT_PLOT = FOUND_LIGHTS
# Pictures written by other commands
PLOTS = ("calibration.png", "light_noise.png", "contact_sheet.png", "curves.png", "maps.png")
CALIBRATION, LIGHT_NOISE_PLOT, CONTACT_SHEET, CURVES, TRAINING_MAPS = PLOTS
# Memory per pixel of the mask for integration, or for the mesh and its files if they need more
BYTES_OF_SURFACE = 600

SURFACE_FILES = {
    "glb": ("mesh.glb",),
    "ply": ("mesh.ply",),
    "obj": ("mesh.obj", "mesh.mtl", "mesh.png", "mesh_roughness.png", "mesh_metalness.png"),
    "stl": ("mesh.stl",),
    "3mf": ("mesh.3mf",),
    "npy": ("depth.npy",),
    "tiff": ("depth.tiff",),
    "png": ("depth.png",),
    "exr": ("depth.exr",),
}
"""The file names of each format. The pictures are the textures of an OBJ file, which exist if there
are colours and a material."""
# Files written by `integrate --level`
LEVEL_NORMALS = LEVEL_MAP, LEVEL_PICTURE = ("level_normals.npy", "level_normals.png")
SURFACE_REPORT = "surface.json"  # the report of `integrate`


def file_names(formats: Sequence[str]) -> tuple[str, ...]:
    """Return the names of all files that encode_surface may yield."""
    return tuple(name for form in formats for name in SURFACE_FILES[form])


@dataclass(frozen=True, kw_only=True)
class OutputMap:
    """A row of MAPS.

    Args:
        name: the name in --maps, to which each of the suffixes is added for the file names.
        content: description for the documentation.
        unit: description of the values in TIFF and EXR files.
        scale: the value that is white in the picture by default.
        scale_text: description of the scale in the file.
        caption: text below the picture on the page, which shows this map even without --maps; "" if
            the map is not on the page.
        needs_confidence: whether the map is available only for methods with confidence.
        reads_images: whether the images are read again.
        bytes_per_pixel, bytes_per_observation: required memory. Maps that need any are computed
            before the others are written.
        seconds, seconds_per_pixel: the expected time for a slow map, without reading the images.
        fewest_lights: with fewer lights, the map is refused.
        parts: the names and channels of its parts, if the map is written as several maps.
    """

    name: str
    content: str
    unit: str = ""
    suffixes: tuple[str, ...] = ("npy", "tiff", "png")
    scale: float | None = None
    scale_text: str = ""
    caption: str = ""
    needs_confidence: bool = False
    reads_images: bool = False
    bytes_per_pixel: int = 0
    bytes_per_observation: int = 0
    seconds: float = 0.0
    seconds_per_pixel: float = 0.0
    fewest_lights: int = 0
    parts: "tuple[MapPart, ...]" = ()

    @property
    def files(self) -> dict[str, str]:
        """The names of the map's files by suffix, or by name if it has parts."""
        if self.parts:
            return {name: name for part in self.parts for name in part.files}
        return {suffix: f"{self.name}.{suffix}" for suffix in self.suffixes}

    def check_lights(self, count: int, path: Path | None = None) -> None:
        """Raise InputError for the capture in `path` if there are too few lights for the map."""
        if count < self.fewest_lights:
            raise InputError(
                f"--maps {self.name} needs at least {self.fewest_lights} lights, found {count}",
                path=path,
                hint=f"Use more lights, or leave {self.name} out",
            )


@dataclass(frozen=True)
class MapPart:
    """Channels of a map that are written as a map of their own, which is (H, W) for a single
    channel.
    """

    name: str
    first: int  # first channel
    last: int  # channel after the last one
    has_values: bool = True

    @property
    def files(self) -> list[str]:
        """The names of the part's files."""
        return [f"{self.name}.npy"] * self.has_values + [f"{self.name}.png"]


_ROWS = (
    OutputMap(
        name="albedo",
        content="diffuse albedo without highlights and cast shadows; float32, H x W x 3, linear"
        " RGB, up to a factor. The picture is 8-bit sRGB, the EXR file float16",
        unit="linear RGB",
        suffixes=("npy", "exr", "png"),
        caption="Diffuse albedo, scaled so that the brightest 1 % of the pixels are white",
        reads_images=True,
        bytes_per_pixel=52,  # the colours of two images, sums and the map
        bytes_per_observation=1,
    ),
    OutputMap(
        name="confidence",
        content="the probability that a normal has an error of at most 5 degrees; float32, H x W,"
        " zero outside the mask; white is 1",
        suffixes=("npy", "png"),
        caption="Confidence: the probability that the normal is at most 5° off, from 0 (black) to"
        " 1 (white)",
        needs_confidence=True,
    ),
    OutputMap(
        name="preview",
        content="the surface in matte white under a raking light from the upper left",
        suffixes=("png",),
    ),
    OutputMap(
        name="gradient",
        content="the slopes dz/dx and dz/dy; float32, H x W x 2, NaN outside the mask",
        unit="slopes dz/dx and dz/dy, x right, y up",
        suffixes=("npy", "tiff"),
    ),
    OutputMap(
        name="curvature",
        content="mean and Gaussian curvature of the normals, smoothed over 2 pixels; float32, H x W"
        " x 2, in 1/pixel and 1/pixel^2. Bumps are positive. The picture shows the mean curvature:"
        " gray is 0, white 0.05 per pixel",
        unit="mean and Gaussian curvature, 1/pixel and 1/pixel^2",
        scale=0.05,
        scale_text="mean curvature, black -{scale}, gray 0, white {scale} per pixel",
    ),
    OutputMap(
        name="relief",
        content="heights without the overall shape; float32, H x W, in pixels, NaN outside the"
        " mask. The high-pass filter halves the amplitude of 64-pixel wavelengths. In the"
        " picture, gray is 0 and white 1 pixel",
        unit="heights in pixels",
        scale=1.0,
        scale_text="height, black -{scale}, gray 0, white {scale} pixels",
        bytes_per_pixel=BYTES_OF_SURFACE,
    ),
    OutputMap(
        name="material",
        content="base colour, roughness, metalness, specular reflection and their confidence;"
        " float32, zero outside the mask. The pictures have 8 bits: base colour in sRGB, and"
        " glTF's texture with roughness in green and metalness in blue",
        reads_images=True,
        bytes_per_pixel=170,  # the maps, and the gloss of each pixel
        bytes_per_observation=5,
        seconds=2.5,
        seconds_per_pixel=1e-5,
        fewest_lights=4,
        parts=(
            MapPart("base_colour", 0, 3),
            MapPart("roughness", 3, 4),
            MapPart("metalness", 4, 5),
            MapPart("specular", 5, 6),
            MapPart("material_confidence", 6, 7),
            MapPart(GLOSS.removesuffix(".png"), 3, 5, has_values=False),
        ),
    ),
)
MAPS = {row.name: row for row in _ROWS}


def own_files() -> list[str]:
    """Return the names of all files, except FOUND_LIGHTS, that `infer` and `integrate` may
    write.
    """
    maps = (name for row in MAPS.values() for name in row.files.values())
    surface = (*file_names(tuple(SURFACE_FILES)), *LEVEL_NORMALS, SURFACE_REPORT)
    own = (FOUND_MASK, MENDED_LIGHTS, CAPTURE_SHEET, PAGE, REPORT)
    return [*NORMALS.values(), ERROR_MAP, *maps, *surface, *own]
