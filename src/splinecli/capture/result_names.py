"""The names of all files that splinecli writes for people. A folder of images does not take them for photographs."""

from splinecli.surface.surface_files import SURFACE_FILES, SURFACE_REPORT, file_names

NORMALS = {
    "png": "normals.png",
    "png8": "normals_8bit.png",
    "npy": "normals.npy",
    "tiff": "normals.tiff",
    "exr": "normals.exr",
}
"""The file of the normal map in each format."""

ERROR_MAP = "error_map.png"
REPORT, PAGE, FOUND_MASK = "report.json", "page.html", "found_mask.png"
ALBEDO_PICTURE, ALBEDO, ALBEDO_EXR, PREVIEW = "albedo.png", "albedo.npy", "albedo.exr", "preview.png"
CONFIDENCE_PICTURE, CONFIDENCE = "confidence.png", "confidence.npy"
LIGHT_FILES = LIGHT_DIRECTIONS, LIGHT_INTENSITIES, LIGHT_PLOT = (
    "light_directions.txt",
    "light_intensities.txt",
    "lights.png",
)
"""What `infer` writes of lights that it found. In a folder that is also the capture's, such files may be the user's."""

GRADIENT, GRADIENT_TIFF = "gradient.npy", "gradient.tiff"
CURVATURE_PICTURE, CURVATURE, CURVATURE_TIFF = "curvature.png", "curvature.npy", "curvature.tiff"
RELIEF_PICTURE, RELIEF, RELIEF_TIFF = "relief.png", "relief.npy", "relief.tiff"
MAPS = {
    "albedo": (ALBEDO_PICTURE, ALBEDO, ALBEDO_EXR),
    "confidence": (CONFIDENCE_PICTURE, CONFIDENCE),
    "preview": (PREVIEW,),
    "gradient": (GRADIENT, GRADIENT_TIFF),
    "curvature": (CURVATURE_PICTURE, CURVATURE, CURVATURE_TIFF),
    "relief": (RELIEF_PICTURE, RELIEF, RELIEF_TIFF),
}
"""The files of each optional map."""

SCALED_MAPS = ("curvature", "relief")  # maps whose picture has a fixed scale, which the user may choose
OWN_FILES = (
    *NORMALS.values(),
    ERROR_MAP,
    *(name for names in MAPS.values() for name in names),
    *file_names(tuple(SURFACE_FILES)),
    SURFACE_REPORT,
    FOUND_MASK,
    PAGE,
    REPORT,
)
"""All files that `infer` and `integrate` may write into a capture's folder of results, but LIGHT_FILES."""

PLOTS = CALIBRATION, LIGHT_NOISE_PLOT, CONTACT_SHEET, CURVES, TRAINING_MAPS = (
    "calibration.png",
    "light_noise.png",
    "contact_sheet.png",
    "curves.png",
    "maps.png",
)
"""Pictures that the other commands write."""
