"""The report of a calibration: calibration.json, its warnings, and its summary for people."""

from typing import Any

import numpy as np

from splinecli.calibration.balls import CalibratedLights
from splinecli.calibration.lamp_positions import LampPositions
from splinecli.maths import Doubles
from splinecli.maths.normals import angle_between_deg

UNSURE_VISIBLE = 0.6  # smallest visible share of an outline without a warning
UNSURE_SPREAD = 0.01  # largest spread of an outline without a warning, as a share of the radius
DISAGREEMENT_DEG = 5.0  # largest angle between a ball and the mean of all balls without a warning

MISTAKEN_DEG = 3.0
"""Smallest mean difference at which compared directions are checked for the mistake of mirror_ball.py."""


def calibration_report(
    lights: CalibratedLights,
    intensities: Doubles | None,
    known_directions: Doubles | None,
    *,
    picture: str,
    lamps: LampPositions | None = None,
) -> dict[str, Any]:
    """Return the report of a calibration as values for JSON, with its warnings.

    Args:
        intensities: (F, 3), or None where they were not measured.
        known_directions: (F, 3) unit vectors to compare the result with, or None.
        picture: the name of the picture to which warnings refer.
    """
    single, view = len(lights.balls) == 1, lights.balls[0].view
    off_deg = None if known_directions is None else angle_between_deg(known_directions, lights.directions)
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
                "highlights": [[_round(highlight.x), _round(highlight.y)] for highlight in ball.highlights],
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
            # Infinite where a lamp may be at any distance.
            "uncertainty": [_round(value) if np.isfinite(value) else None for value in lamps.uncertainty],
            "pixel_size": _round(lamps.pixel_size, 6),
        },
        "disagreement_deg": None if single else _mean_and_largest(lights.disagreement_deg),
        "compared": None if off_deg is None else _mean_and_largest(off_deg, "_deg"),
        "warnings": _warnings(lights, known_directions, picture, lamps),
    }


def summary_lines(report: dict[str, Any]) -> list[str]:
    """Return the lines of a report for people: the outlines, and how well balls and compared lights agree."""
    lines = []
    for ball in report["balls"]:
        circle = ball["circle"]
        lines.append(
            f"{ball['folder']}: circle {circle['x']:.1f}, {circle['y']:.1f}, radius {circle['radius']:.1f} pixels"
            f" (from {circle['from']}, {100 * circle['seen']:.0f} % of the outline visible,"
            f" spread {circle['spread']:.1f} pixels)"
        )
    if angles := report["disagreement_deg"]:
        text = f"the balls differ from their mean by {angles['mean']:.1f} degrees, at most {angles['largest']:.1f}"
        lines.append(text)
    lamps = report["lamp_positions"]
    if lamps and not lamps["known"]:
        lines.append("the lamps' distances are unknown: they count as distant")
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


def _warnings(lights: CalibratedLights, known: Doubles | None, picture: str, lamps: LampPositions | None) -> list[str]:
    warnings = [
        f"{ball.files.folder}: the outline of the ball is uncertain ({100 * ball.circle.visible:.0f} % of it visible,"
        f" spread {ball.circle.spread:.1f} pixels). Check {picture}; if the green circle is wrong, give --mask or"
        " --circle."
        for ball in lights.balls
        if ball.circle.visible < UNSURE_VISIBLE or ball.circle.spread > UNSURE_SPREAD * ball.circle.radius
    ]
    if lamps is not None and not lamps.known:
        warnings.append(
            "The rays from the balls are too parallel to tell the lamps' distances. If the lamps are near, put the"
            " balls farther apart."
            if lamps.view.known
            else "The lamps' distances are unknown, because the camera is: it counts as distant, and a near camera"
            " makes the rays from the balls too parallel. If the lamps are near, add --camera-matrix."
        )
    worst = int(lights.disagreement_deg.argmax())
    largest = lights.disagreement_deg[worst]
    if largest > DISAGREEMENT_DEG and not (lamps is not None and lamps.known):
        warnings.append(
            f"The balls disagree by up to {largest:.1f} degrees, most under light {worst + 1} (counted from 1)."
            f" Check {picture}."
        )
    if known is not None:
        difference = angle_between_deg(known, lights.directions).mean()
        from_normals = np.mean([angle_between_deg(known, ball.normals).mean() for ball in lights.balls])
        if difference > MISTAKEN_DEG and from_normals < difference / 3:
            warnings.append(
                "The compared file contains the normals of the ball at the highlights instead of the light directions:"
                " each lies half-way between the view and the light. Use the file written here."
            )
    return warnings


def _mean_and_largest(angles_deg: Doubles, unit: str = "") -> dict[str, float]:
    return {f"mean{unit}": _round(angles_deg.mean()), f"largest{unit}": _round(angles_deg.max())}


def _rows(values: Doubles) -> list[list[float]]:
    return [[_round(value, 6) for value in row] for row in values]


def _round(value: float, digits: int = 3) -> float:
    return round(float(value), digits)
