"""The documents that commands write and print as JSON, from which docs/reports.schema.json is
generated.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import UNSET, Meta, Struct, UnsetType, to_builtins
from msgspec.json import schema_components

from splinecli.maths.normals import AngularErrors
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.records.base import Count, Natural, NotNegative, Positive, Share
from splinecli.records.capture_warnings import WARNINGS
from splinecli.records.white_level import WhiteLevel
from splinecli.system.progress import STAGES

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]  # camera matrix or transform, in pixels
Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Camera = Literal["orthographic", "perspective"]
Unit = Literal["pixel", "mean depth", "millimetre"]
Code = Annotated[str, Meta(extra_json_schema={"enum": sorted(WARNINGS)})]
LightCount = Annotated[int, Meta(ge=MIN_LIGHTS)]
DrawnLights = LightCount | Literal["all"]
ImageSize = tuple[Count, Count]  # width and height


class Document(Struct, kw_only=True, forbid_unknown_fields=True):
    """A part of a document."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        # Numbers may be NumPy's.
        values: dict[str, Any] = to_builtins(self, enc_hook=lambda number: number.item())
        return values


class UsedWeights(Document):
    """A weight file."""

    name: str
    sha256: Digest


class NearLampsReport(Document):
    """Near lamps: their distances from the middle of the object. All lengths have the same unit."""

    distances: list[Positive]
    pixel_size: Positive
    camera: Camera
    camera_matrix: Matrix | None
    lobes: list[tuple[float, float, float, float]] | None


class MeanAndTail(Document):
    """Mean and 95th percentile, in degrees."""

    mean: float
    p95: float


class Distillation(Document):
    """How a capture was distilled, with numbers of pixels and angles in degrees."""

    sample: Natural
    held_out: Natural
    angle_to_network_deg: MeanAndTail
    expected_error_deg: float
    unlike_pixels: Natural


class WarningReport(Document):
    """A warning."""

    code: Code
    text: str


class SurfaceFacts(Document):
    """Depth map and mesh."""

    camera: Camera
    unit: Unit
    pixel_size_mm: Positive | None
    range: tuple[float, float]
    n_vertices: Natural
    n_triangles: Natural
    normal_texture: bool
    discontinuity: NotNegative


class AlignmentReport(Document):
    """How moved images were aligned.

    The transforms apply to pixels (x, y, 1) of the reference, and motions are in pixels.
    """

    reference: str
    model: Literal["translation", "similarity", "homography"]
    transforms: list[Matrix]
    moved_pixels: list[NotNegative]


class MaterialFacts(Document):
    """The material: whether the images are gray, and how well they determine it."""

    gray: bool
    mean_confidence: Share
    determined: Share  # the share of the pixels whose confidence is at least 0.5
    median_roughness: Share


class EstimateReport(Document):
    """The part of the report of infer that describes the estimate."""

    schema: Literal[3]  # incremented when the meaning of a field changes
    capture: str
    method: str
    weights: UsedWeights | None
    n_lights: LightCount
    light_indices: list[Natural]
    light_source: Literal["given", "estimated"]
    light_file: str | None
    light_directions: list[Vector]
    light_errors_deg: list[NotNegative] | None
    near_lamps: NearLampsReport | None
    camera_matrix: Matrix | None
    estimated_intensities: list[Any] | None
    n_pixels: Count
    image_size: ImageSize
    device: str
    precision: str
    distillation: Distillation | None
    peak_memory_mib: Natural | None
    warnings: list[WarningReport]
    angular_error_deg: AngularErrors | None
    expected_under_5: Share | None
    capture_judged: bool | None
    options: dict[str, Any]
    inputs_sha256: Digest
    version: str
    reading: Annotated[str, Meta(pattern="^(restored|as stored)$")]
    white_level: WhiteLevel | None
    # standard deviation in pixels of the blur that was removed from the images
    removed_blur: float | None
    alignment: AlignmentReport | None
    mended: list[Code]  # unambiguous faults that were corrected
    material: MaterialFacts | None
    surface: SurfaceFacts | None


class Report(EstimateReport):
    """report.json of infer, and each item of the list printed by infer --json."""

    seconds: Annotated[
        dict[str, NotNegative], Meta(extra_json_schema={"required": [*STAGES, "total"]})
    ]
    folder: str
    files: list[str]
    file_sizes: dict[str, Natural]


class LevelReport(Document):
    """The slope that was removed, in x and y, and its angle."""

    slopes: tuple[float, float]
    tilt_deg: NotNegative


class SurfaceReport(SurfaceFacts):
    """surface.json, and the document printed by integrate --json."""

    schema: Literal[3]
    normals: str
    colours: str | None
    prior: str | None
    level: LevelReport | None
    pixel_aspect: Positive
    solid_mm: Positive | None  # the thickness of a closed mesh
    n_pixels: Natural
    image_size: ImageSize
    seconds: NotNegative
    folder: str
    files: list[str]


class ProtocolReport(Document):
    """The settings of an evaluation. With several evaluations, settings that differ are lists."""

    n_lights: DrawnLights | list[DrawnLights]
    trials: Count
    seed: int
    draws: str | None
    light_noise_deg: NotNegative | list[NotNegative]
    max_pixels: int | None
    skip_first: dict[str, int]
    as_stored: bool
    white_level: float | None
    light_error_deg: float | None
    lights_estimated: bool


class MethodResult(Document):
    """The result of a method on a capture, in degrees and seconds."""

    method: str
    capture: str
    n_lights: LightCount
    light_noise_deg: NotNegative
    mae_deg: NotNegative
    std_deg: NotNegative
    trials: Count
    seconds: NotNegative
    as_stored: bool
    found_light_error_deg: NotNegative | None
    maes_deg: Annotated[list[NotNegative], Meta(min_length=1)]


class ComparisonReport(Document):
    """A comparison of two methods trial by trial, on one capture or averaged over the captures."""

    # The last four fields are None if no test is possible, which is the case with one trial or if
    # the differences of all trials are equal but not zero. If all differences are zero, the
    # interval is (0, 0) and p is 1.
    first: str
    second: str
    capture: str
    n_lights: DrawnLights
    light_noise_deg: NotNegative
    trials: int
    difference_deg: float  # mean difference between the errors of `first` and `second`
    std_deg: NotNegative  # population standard deviation of the differences
    # 95 % confidence interval of the mean difference. It is not corrected for the number of pairs,
    # so it can exclude 0 although `differs` is false
    interval_deg: tuple[float, float] | None
    p_value: float | None
    # p_value corrected for the number of pairs tested on this capture
    p_holm: float | None
    differs: bool | None


class SkippedCapture(Document):
    """A capture that could not be scored."""

    capture: str
    reason: str


class Likeness(Document):
    """How well pictures agree with photographs, over all pixels of the mask and all held-out
    lights.
    """

    psnr_db: float  # peak signal-to-noise ratio, relative to white
    error: NotNegative  # mean absolute difference, relative to the mean of the photographs


class RelightingReport(Document):
    """How well relit pictures of a capture agree with photographs under the lights not in a
    draw.
    """

    capture: str
    method: str
    lights: list[Natural]
    held_out: Count
    material: Likeness
    lambertian: Likeness
    nearest: Likeness


class Results(Document):
    """results.json, and the document printed by evaluate --json."""

    schema: Literal[1]
    protocol: ProtocolReport
    methods: dict[str, dict[str, Any]]
    results: list[MethodResult]
    averages: dict[str, NotNegative | dict[str, NotNegative]]
    comparisons: list[ComparisonReport]
    skipped: list[SkippedCapture]
    notes: list[str]
    version: str
    relighting: list[RelightingReport] | UnsetType = UNSET


class Failure(Document):
    """The document printed instead of a report after an error. Only infer includes the capture's
    name.
    """

    error: str
    exit_code: Count
    capture: str | UnsetType | None = UNSET


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of all documents, for docs/reports.schema.json."""
    references, parts = schema_components(
        (Report, SurfaceReport, Results, Failure), ref_template="#/$defs/{name}"
    )
    for part in parts.values():  # remove the line breaks of docstrings
        if "description" in part:
            part["description"] = " ".join(part["description"].split())
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Documents of splinecli: report.json, surface.json, results.json, and the"
        " document that replaces them after a failure",
        "anyOf": list(references),
        "$defs": parts,
    }
