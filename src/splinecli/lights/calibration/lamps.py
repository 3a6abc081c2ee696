"""Intensities of lamps, positions of near lamps, and the report of a calibration.

Near lamps are located by triangulation from two or more mirror balls. Each ball provides a ray from
the highlight on its surface towards the lamp. The centres of the balls, which follow from the size
of their outlines, are near a plane z = const, which should be the object's mean plane.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from splinecli.capture.files import AMBIENT, CaptureFiles, find_named
from splinecli.capture.formats.facts import check_exposures
from splinecli.capture.formats.images import ExpectedSize, common_size, read_mask
from splinecli.capture.linearise import AS_STORED, RadiometricCalibration, StoredPixels
from splinecli.capture.record import placeholders
from splinecli.capture.source import CaptureSource
from splinecli.errors import InputError
from splinecli.images.saturation import Saturation
from splinecli.lights.calibration.balls import (
    BallCalibration,
    BallFiles,
    CalibratedLights,
    View,
    ball_centre,
    reflect,
)
from splinecli.lights.calibration.circle import Circle, circle_from_mask
from splinecli.maths import Bools, Float64Array, Indices
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.pixel_grid import focal_length, ray_basis

Target = Literal["ball", "card"]


def measure_light_intensities(
    files: BallFiles,
    light_directions: Float64Array,
    target: Target,
    *,
    radiometry: RadiometricCalibration = AS_STORED,
) -> Float64Array:
    """Return light intensities (F, 3), RGB, with mean 1, from images of a gray target.

    According to Lambert's law, each is the median of I / (n.l) over the pixels of the target.
    Images are read and saturated pixels are found as in a capture. Raises InputError if the numbers
    of images and lights differ, an image cannot be read or has another size, or the target is dark
    or saturated under a light.

    Args:
        files: one image of the target for each light, and a mask of the target. A card without a
            mask fills the image. An image called `ambient` in the folder is subtracted.
        light_directions: (F, 3), unit vectors.
        target: a matte ball, or a matte card that faces the camera, with the normal (0, 0, 1).
    """
    n_lights = len(light_directions)
    if len(files.images) != n_lights:
        raise InputError(
            f"found {len(files.images)} images, expected {n_lights}, one for each light",
            path=files.folder,
        )
    normals, rows, images = read_target(files, target, radiometry)
    values, found = [], []
    for image in images:
        found.append(image.find_saturated(None))
        values.append(image.linear.astype(np.float64))
    saturated = Saturation(len(normals), tuple(found), rows=rows, even=True).flags
    cosines = normals[rows] @ light_directions.T
    # smallest n.l of the pixels that are used, because a matte ball is not Lambertian at grazing
    # angles
    smallest = 0.35
    intensities = np.empty((n_lights, 3))
    for position, path in enumerate(files.images):
        ratios = values[position] / np.maximum(cosines[:, position], smallest)[:, None]
        if saturated is not None:
            # The saturated pixels of a uniform card are its brightest, which does not affect the
            # median. On a ball, they are where n.l is largest, so the other pixels suffice.
            ratios[saturated[:, position]] = np.inf if target == "card" else np.nan
        ratios = ratios[(cosines[:, position] > smallest) & ~np.isnan(ratios).any(axis=1)]
        intensity = np.median(ratios, axis=0) if len(ratios) >= 50 else np.zeros(1)
        if not ((intensity > 0) & np.isfinite(intensity)).all():
            raise InputError(
                "the target is dark or overexposed under this light, so the light's intensity is"
                " unknown",
                path=path,
                hint="For every light, take an image of the target that is neither black nor"
                " saturated",
            )
        intensities[position] = intensity
    return np.asarray(intensities / intensities.mean())


def read_target(
    files: BallFiles, target: Target, radiometry: RadiometricCalibration
) -> tuple[Float64Array, Indices, Iterator[StoredPixels]]:
    """Return the normals (P, 3) of a target, the indices of sampled pixels, and their values by
    image.
    """
    mask, normals = _target_normals(files, common_size(files.facts)[0][:2], target)
    check_exposures(files.facts)
    count = len(files.images)
    capture = CaptureSource(
        files=CaptureFiles(
            "gray target", files.folder.name, files.folder, files.images, files.folder
        ),
        facts=files.facts,
        light_directions=placeholders(count),
        light_intensities=np.ones((count, 3)),
        radiometry=replace(radiometry, ambient=find_named(files.folder, AMBIENT)),
    )
    rows = np.linspace(0, len(normals) - 1, min(len(normals), 1 << 16)).astype(np.intp)
    images = capture.read_pixels(mask, range(count), lambda pixels: pixels, wanted=rows)
    return normals, rows, images


def _target_normals(
    files: BallFiles, shape: tuple[int, ...], target: Target
) -> tuple[Bools, Float64Array]:
    """Return the mask (H, W) of the target and the normals (P, 3) of its pixels."""
    mask = np.ones(shape, np.bool_)
    if files.mask is not None:
        mask = read_mask(files.mask, ExpectedSize(shape, files.images[0].name, "a mask"))
    if target == "card":
        return mask, np.broadcast_to(np.array((0.0, 0.0, 1.0)), (int(mask.sum()), 3))
    if files.mask is None:
        raise InputError(
            "the images of the gray ball need a mask", path=files.folder, hint="Add one as mask.png"
        )
    circle = circle_from_mask(mask)
    # Pixels at the rim mix the ball with the background.
    mask &= Circle(circle.x, circle.y, 0.97 * circle.radius).inside(shape)
    y, x = np.nonzero(mask)
    return mask, circle.normals(x.astype(np.float64), y.astype(np.float64))


# standard deviation in pixels of highlights, and of the centre and the radius of outlines
_PIXEL_ERROR = 0.3


@dataclass(frozen=True, eq=False)
class LampPositions:
    """The positions of F lamps; x right, y up, z to the camera.

    The origin is at the centre of the image, on the balls' plane.
    """

    positions: Float64Array  # (F, 3)
    uncertainty: Float64Array  # (F,), the distance that contains the true position in 95 % of cases
    # the width of a pixel on the plane, in the unit of the positions; 1 if they are in pixels
    pixel_size: float
    view: View

    @property
    def known(self) -> bool:
        """Whether every lamp has a well-determined position in front of the balls."""
        # If the uncertainty is larger, the rays are nearly parallel, and the lamp may be at any
        # distance.
        most = 0.4 * np.linalg.norm(self.positions, axis=1)
        return bool((self.positions[:, 2] > 0).all() and (self.uncertainty <= most).all())


def triangulate_lamps(
    balls: Sequence[BallCalibration], *, ball_diameter: float | None = None
) -> LampPositions | None:
    """Return the lamp positions from balls photographed by one camera, or None if all are in one
    place.

    The uncertainty is found by repeating the computation with random errors of the pixels, the
    heights of the balls and the camera (View.draw). It is increased if the distances between the
    rays are larger than these errors explain.

    Args:
        balls: at least two balls, or one ball at two places.
        ball_diameter: the diameter of each ball, in the unit of the result. If it is None, the
            positions are in pixels.
    """
    circles = [ball.circle for ball in balls]
    apart = max(math.hypot(circle.x - circles[0].x, circle.y - circles[0].y) for circle in circles)
    if apart < circles[0].radius or len({ball.shape for ball in balls}) > 1:
        return None
    view = balls[0].view
    positions, pixel_size, miss = _positions(balls, view.matrix, ball_diameter)
    generator = np.random.default_rng(0)
    drawn = [_positions(balls, view.draw(generator), ball_diameter, generator) for _ in range(200)]
    errors = np.array([np.linalg.norm(other - positions, axis=1) for other, _, _ in drawn])
    errors[np.isnan(errors)] = np.inf
    # If _PIXEL_ERROR is correct, a draw increases the distances between the rays by as much as the
    # errors in the images did.
    added = float(np.nanmedian([other for _, _, other in drawn])) - miss
    excess = math.sqrt(max(1.0, miss / added if added > 0 else 1.0))
    uncertainty = excess * np.quantile(errors, 0.95, axis=0, method="higher")
    return LampPositions(positions, uncertainty, pixel_size, view)


def _positions(
    balls: Sequence[BallCalibration],
    matrix: Float64Array,
    diameter: float | None,
    errors: np.random.Generator | None = None,
) -> tuple[Float64Array, float, float]:
    """Return the positions (F, 3), the pixel size and the mean square angle by which the rays miss.

    `errors` draws random errors of the pixels; None adds no errors.
    """

    def error(*shape: int) -> Float64Array:
        return np.zeros(shape) if errors is None else errors.normal(size=shape)

    centres = np.array(
        [ball_centre(ball.circle.outline + _PIXEL_ERROR * error(2), matrix) for ball in balls]
    )
    depths = -centres[:, 2]
    shares = np.array([_PIXEL_ERROR / ball.circle.radius for ball in balls])
    plane = float(depths.mean() * (1 + (shares * error(len(balls))).mean()))
    # The most probable depths, given the depths from the outlines and a standard deviation of half
    # a radius between the heights of the centres. This matters for a distant camera, where the
    # outlines do not determine the heights.
    weights = 0.5**2 / (0.5**2 + (shares * depths) ** 2)
    likely = (
        plane
        + weights * (depths - depths.mean())
        + np.sqrt(weights) * shares * depths * error(len(balls))
    )
    centres *= (likely / depths)[:, None]
    height, width = balls[0].shape
    origin = np.array(((width - 1) / 2, (height - 1) / 2, 1.0)) @ ray_basis(matrix) * plane
    starts, towards = [], []
    for centre, ball in zip(centres, balls, strict=True):
        normals, directions = reflect(
            centre, ball.points + _PIXEL_ERROR * error(*ball.points.shape), matrix
        )
        starts.append(centre - origin + normals)
        towards.append(directions)
    points, miss = intersect_rays(np.array(starts), np.array(towards))
    pixel = plane / focal_length(matrix)  # in radii of the balls
    unit = 1 / pixel if diameter is None else diameter / 2
    return points * unit, pixel * unit, miss


def intersect_rays(starts: Float64Array, directions: Float64Array) -> tuple[Float64Array, float]:
    """Return the points (F, 3) nearest to B rays each, and the mean square angle of the misses.

    The rays are (B, F, 3), B at least 2, with unit directions that have equal random errors. Points
    of rays with NaN are NaN.
    """
    usable = np.isfinite(directions).all(axis=(0, 2))
    points = np.full(starts.shape[1:], np.nan)
    starts, directions = starts[:, usable], directions[:, usable]
    # Projections perpendicular to each ray. Their sum is singular for parallel rays.
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    weights = np.ones(starts.shape[:2])
    # Distances to a ray are weighted by the distance along it, which is not known at first.
    for _ in range(3):
        weighted = across * weights[..., None, None]
        right_side = np.einsum("bfij,bfj->fi", weighted, starts)
        inverse = np.linalg.pinv(weighted.sum(axis=0), hermitian=True)
        nearest = np.einsum("fij,fj->fi", inverse, right_side)
        misses = np.einsum("bfij,bfj->bfi", across, nearest - starts)
        weights = np.maximum(np.linalg.norm(nearest - starts, axis=2), 1e-12) ** -2.0
    points[usable] = nearest
    return points, float(
        (weights * np.square(misses).sum(axis=2)).mean()
    ) if usable.any() else math.nan


def calibration_report(
    lights: CalibratedLights,
    intensities: Float64Array | None,
    known_directions: Float64Array | None,
    *,
    picture: str,
    lamps: LampPositions | None = None,
) -> dict[str, Any]:
    """Return the report of a calibration, including its warnings, as JSON values.

    Args:
        intensities: (F, 3), or None if they were not measured.
        known_directions: (F, 3) unit vectors to compare the result with, or None.
        picture: the name of the picture that warnings refer to.
    """
    single, view = len(lights.balls) == 1, lights.balls[0].view
    off_deg = (
        None if known_directions is None else angle_between_deg(known_directions, lights.directions)
    )
    return {
        "n_lights": len(lights.directions),
        "camera": {"from": view.source, "matrix": _rows(view.matrix) if view.known else None},
        "balls": [
            {
                "folder": str(ball.files.folder),
                "circle": {
                    **{name: _round(getattr(ball.circle, name)) for name in ("x", "y", "radius")},
                    "from": ball.circle_from,
                    "seen": _round(ball.circle.visible),
                    "spread": _round(ball.circle.spread),
                },
                "highlights": [
                    [_round(highlight.x), _round(highlight.y)] for highlight in ball.highlights
                ],
                "saturated": [_round(highlight.saturated) for highlight in ball.highlights],
            }
            for ball in lights.balls
        ],
        "light_directions": _rows(lights.directions),
        "light_intensities": None if intensities is None else _rows(intensities),
        "lamp_positions": None
        if lamps is None
        else {
            "known": lamps.known,
            "positions": _rows(lamps.positions),
            # Infinite if a lamp may be at any distance.
            "uncertainty": [
                _round(value) if np.isfinite(value) else None for value in lamps.uncertainty
            ],
            "pixel_size": _round(lamps.pixel_size, 6),
        },
        "disagreement_deg": None if single else _mean_and_largest(lights.disagreement_deg),
        "compared": None if off_deg is None else _mean_and_largest(off_deg, "_deg"),
        "warnings": _warnings(lights, known_directions, picture, lamps),
    }


def calibration_lines(report: dict[str, Any]) -> list[str]:
    """Return the lines of a report on the terminal.

    They describe the outlines, and how well the balls and the compared lights agree.
    """
    lines = []
    for ball in report["balls"]:
        circle = ball["circle"]
        lines.append(
            f"{ball['folder']}: circle {circle['x']:.1f}, {circle['y']:.1f}, radius"
            f" {circle['radius']:.1f} pixels (from {circle['from']}, {100 * circle['seen']:.0f} %"
            f" of the outline visible, spread {circle['spread']:.1f} pixels)"
        )
    if angles := report["disagreement_deg"]:
        lines.append(
            f"the balls differ from their mean by {angles['mean']:.1f} degrees, at most"
            f" {angles['largest']:.1f}"
        )
    lamps = report["lamp_positions"]
    if lamps and not lamps["known"]:
        lines.append("the distances of the lamps are unknown, so the lamps are treated as distant")
    elif lamps:
        distances = np.linalg.norm(lamps["positions"], axis=1)
        shares = 100 * np.array(lamps["uncertainty"]) / distances
        lines.append(
            f"the lamps are {distances.min():.4g} to {distances.max():.4g} away"
            f" ({'pixels' if lamps['pixel_size'] == 1 else 'in the unit of --ball-diameter'}),"
            f" uncertain by {shares.mean():.0f} % on average, at most {shares.max():.0f} %"
        )
    if angles := report["compared"]:
        text = f"the compared file differs by {angles['mean_deg']:.1f} degrees on average, at most"
        lines.append(f"{text} {angles['largest_deg']:.1f}")
    return lines


def _warnings(
    lights: CalibratedLights, known: Float64Array | None, picture: str, lamps: LampPositions | None
) -> list[str]:
    warnings = [
        f"{ball.files.folder}: the outline of the ball is uncertain"
        f" ({100 * ball.circle.visible:.0f} % of it visible, spread {ball.circle.spread:.1f}"
        f" pixels). Check {picture}; if the green circle is wrong, add --mask or --circle."
        for ball in lights.balls
        # too little of the outline is visible, or it varies by more than 1 % of the radius
        if ball.circle.visible < 0.6 or ball.circle.spread > 0.01 * ball.circle.radius
    ]
    if lamps is not None and not lamps.known:
        warnings.append(
            "The rays from the balls are too parallel to measure the lamps' distances. If the"
            " lamps are near, move the balls farther apart."
            if lamps.view.known
            else "The lamps' distances are unknown, because the camera is unknown and treated as"
            " distant. If it is near, this makes the rays from the balls too parallel. If the"
            " lamps are near, add --camera-matrix."
        )
    worst = int(lights.disagreement_deg.argmax())
    largest = lights.disagreement_deg[worst]  # below 5 for accurate balls
    if largest > 5.0 and not (lamps is not None and lamps.known):
        warnings.append(
            f"The balls disagree by up to {largest:.1f} degrees, most under light {worst + 1}"
            f" (counted from 1). Check {picture}."
        )
    if known is not None:
        difference = angle_between_deg(known, lights.directions).mean()
        from_normals = np.mean(
            [angle_between_deg(known, ball.normals).mean() for ball in lights.balls]
        )
        # Smaller differences may have other causes.
        if difference > 3.0 and from_normals < difference / 3:
            warnings.append(
                "The compared file contains the normals of the ball at the highlights, which are"
                " halfway between the view and the light, instead of the light directions. Use the"
                " file written here."
            )
    return warnings


def _mean_and_largest(angles_deg: Float64Array, unit: str = "") -> dict[str, float]:
    return {f"mean{unit}": _round(angles_deg.mean()), f"largest{unit}": _round(angles_deg.max())}


def _rows(values: Float64Array) -> list[list[float]]:
    return [[_round(value, 6) for value in row] for row in values]


def _round(value: float, digits: int = 3) -> float:
    return round(float(value), digits)
