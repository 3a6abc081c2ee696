"""Warnings from a check of lights: what does not fit, by how much, and what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture import capture_warnings as codes
from splinecli.capture.capture_warnings import CaptureWarning
from splinecli.capture.lights.light_frames import BOTH_NEGATED, LightFrame
from splinecli.diagnosis.evidence import StatedLights
from splinecli.diagnosis.light_check import Candidate, LightCheck
from splinecli.diagnosis.light_order import UNKNOWN_ORDER, ZENITH

TOLD_APART = 0.5  # smallest difference of advantages that tells two frames apart


def light_warnings(check: LightCheck, lights: StatedLights, *, strict: bool = False) -> list[CaptureWarning]:
    """Return the warnings about lights that were read in a frame, which the advice replaces.

    Args:
        strict: also warn of what the images do not tell. It says nothing about most reliefs without an outline.
    """
    frame, light_file = lights.frame, lights.origin
    warnings = []
    if check.order is not None:
        code = codes.LIGHT_FRAME if check.order == ZENITH else codes.LIGHT_ORDER
        warnings.append(CaptureWarning(code, _order_text(check, light_file)))
    if check.best is not None:
        code = codes.LIGHT_FRAME if check.best.frame is not None else codes.LIGHT_ORDER
        warnings.append(CaptureWarning(code, _frame_text(check, check.best, frame, light_file)))
    if strict and check.unchecked:
        text = f"This could not be checked of the lights of {light_file.name}: {'; '.join(check.unchecked)}."
        warnings.append(CaptureWarning(codes.LIGHTS_UNCHECKED, text))
    return warnings


def _order_text(check: LightCheck, light_file: Path) -> str:
    given = 100 * check.given_misfit
    if check.order == UNKNOWN_ORDER:
        return (
            f"The images fit {light_file.name} no better than lights in a random order"
            f" (misfit {given:.0f} % of a random order's). Its lines are in another order than the"
            " images, or it belongs to another capture."
        )
    remedy = "Check that its lines are in the order of the images."
    if check.order == ZENITH:
        remedy = "Replace each elevation by 90 degrees minus it."
    return (
        f"The images fit the lights of {light_file.name} much better {check.order}"
        f" (misfit {100 * check.order_misfit:.0f} % of a random order's, against {given:.0f} %). {remedy}"
    )


def _frame_text(check: LightCheck, best: Candidate, frame: LightFrame, light_file: Path) -> str:
    pairs = (("curl", best.curl, check.given.curl, ".2f"), ("outline", best.rim, check.given.rim, "+.2f"))
    figures = [
        f"{name} {one:{form}} against {other:{form}}"
        for name, one, other, form in pairs
        if f"{one:{form}}" != f"{other:{form}}"
    ]
    twin = mirror_twin(check, best)
    words = best.name if best.frame is None else f"with {best.name}"
    if twin is not None:
        words += f" or with {twin.name}"
    text = f"The lights give normals that fit a surface much better {words} ({', '.join(figures)})"
    if best.frame is None:
        return f"{text}. Check that the lines of {light_file.name} are in the order of the images."
    advice = f"{text}: run again with --light-frame {best.frame.after(frame)}."
    if twin is not None and twin.frame is not None:
        return (
            f"{advice[:-1]} or {twin.frame.after(frame)}. They exchange hollows and bumps; without a closed outline,"
            " only you can tell which is right."
        )
    if best.frame.signs == (-1, -1, 1) and not best.frame.exchanged:
        advice += " If the object is hollow up to its outline, as the inside of a bowl, the lights are right."
    return advice


def mirror_twin(check: LightCheck, best: Candidate) -> Candidate | None:
    """Return the reading with x and y negated in addition, if the evidence cannot tell it from the best one."""
    if best.frame is None:
        return None
    frame = BOTH_NEGATED.after(best.frame)
    twin = next(candidate for candidate in check.candidates if candidate.frame == frame)
    return twin if twin is not check.given and twin.advantage > best.advantage - TOLD_APART else None


def candidate_rows(check: LightCheck) -> list[dict[str, Any]]:
    """Return the compared readings of a light file as JSON values; figures that cannot be told are null.

    Frames come first, then orders, which are judged by their misfit alone.
    """
    readings = [
        (candidate.name, (check.order_misfit, candidate.curl, candidate.rim, candidate.advantage))
        for candidate in check.candidates
    ]
    readings += [(words, (misfit, np.nan, np.nan, np.nan)) for words, misfit in check.tried]
    rows = []
    for words, values in readings:
        rounded = [round(value, 3) if np.isfinite(value) else None for value in values]
        rows.append(dict(zip(("reading", "misfit", "curl", "rim", "advantage"), (words, *rounded), strict=True)))
    return rows
