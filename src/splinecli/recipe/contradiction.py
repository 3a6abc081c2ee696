"""Detect given lights that contradict the images, with the network that estimates normals.

Under wrong lights, the network predicts larger errors, and its normals do not fit a surface (see
estimate/light_descent.py). A few steps of a descent show whether better lights are near, whether
the given ones are tilted or have a wrong frame, order or elevation. If so, lights are estimated
from the images alone (lights/unknown_lights.py) and compared with the given ones. If the values are
wrong, for example under near lamps, the cost also falls under other lights, so the threshold is
higher if another warning doubts the values.

The thresholds were chosen on rendered captures (benchmarks/judgement.py). On draws from seven
photographed objects with measured lights, the cost falls by at most 0.4.
"""

from splinecli.judge.checks import Finding, Judgement, Remedy
from splinecli.judge.light_check import WRITES_MENDED
from splinecli.lights.light_fit import refine_lights
from splinecli.maths.normals import angle_between_deg
from splinecli.recipe.work import Work
from splinecli.records.capture_warnings import (
    ELEVATION_SUSPECTED,
    FAULTS_OF_LIGHTS,
    LIGHTS_CONTRADICTED,
    LIGHTS_UNCERTAIN,
    ROUGH_LIGHTS,
    CaptureWarning,
)

# decreases of the cost from which lights are estimated, the confidence is lowered, the fault is
# clear, and the fault is clear even if the values are doubted
_DOUBT, _UNCERTAIN, _CLEAR, _ANYWAY = 0.5, 0.8, 1.2, 2.0
# of estimated lights, and the least angle from the given lights in units of their error
_LARGEST_ERROR_DEG, _TIMES = 12.0, 2.0


def ask_network(work: Work, judgement: Judgement) -> Judgement:
    """Return the judgement after the network has compared the given lights with others.

    Estimated lights, near lamps, and captures that are corrected anyway are not compared.

    Raises ModelError.
    """
    from splinecli.estimate.light_descent import LightWitness, best_lights
    from splinecli.lights.unknown_lights import find_lights

    capture = work.made
    near = capture.lamps is not None or capture.camera_matrix is not None
    if near or capture.light_errors_deg is not None or judgement.remedy is not None:
        return judgement
    values, given = capture.observations, capture.light_directions
    known = capture.estimated_intensities is None
    witness = LightWitness.of(values, capture.mask, given)
    if any(each.kind is ROUGH_LIGHTS for each in judgement.warnings):
        # A matte model may also have refined the lights to fit gloss or fabric, unlike the network.
        refined = refine_lights(values, given)
        if refined is None or witness.cost(given) - witness.cost(refined.directions) < _UNCERTAIN:
            kept = [each for each in judgement.warnings if each.kind is not ROUGH_LIGHTS]
            judgement = judgement._replace(warnings=tuple(kept))
    fall, moved_deg = witness.descend(intensities_known=known)
    if fall < _DOUBT:
        return judgement
    found = find_lights(values, capture.mask, known, best_lights, refuse=False)
    of_found = witness.cost(given) - witness.cost(found.directions)
    apart, stated = angle_between_deg(found.directions, given).mean(), found.errors_deg.mean()
    others = [each for each in judgement.warnings if each.kind not in FAULTS_OF_LIGHTS]
    least = _ANYWAY if any(each.is_error for each in others) else _CLEAR
    if any(each.kind is ELEVATION_SUSPECTED for each in judgement.warnings):
        least = _UNCERTAIN  # independent evidence
    if of_found > least and stated < _LARGEST_ERROR_DEG and apart > _TIMES * stated:
        cause = (
            f"The lights of {work.source.lights_file.name} contradict the images, which fit other"
            f" lights, {apart:.0f} degrees away on average, with an expected error of {stated:.1f}"
            " degrees."
        )
        text = (
            f"{cause} Check their frame, order and elevations; {WRITES_MENDED} writes the others."
        )
        warning = CaptureWarning(LIGHTS_CONTRADICTED, text, float(apart))
        finding = Finding(warning, clear=True, cause=cause)
        remedy = Remedy((finding,), found.directions, light_error_deg=float(stated))
        return judgement._replace(
            warnings=(*others, warning), mended_lights=found.directions, remedy=remedy
        )
    if fall > _UNCERTAIN and not any(each.is_error for each in judgement.warnings):
        text = (
            f"Under lights that differ by {moved_deg:.0f} degrees on average, the network predicts"
            " smaller errors and finds a better surface. The given lights may be inaccurate, or the"
            " material unusual, so the confidence is lowered."
        )
        warning = CaptureWarning(LIGHTS_UNCERTAIN, text, moved_deg / 2)
        return judgement._replace(warnings=(*judgement.warnings, warning))
    return judgement
