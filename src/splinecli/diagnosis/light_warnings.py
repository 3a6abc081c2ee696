"""The warnings about light directions in a wrong frame or order, with their remedies."""

from pathlib import Path

from splinecli import capture_warnings as codes
from splinecli.capture.lights.light_frames import BOTH_NEGATED, LightFrame
from splinecli.capture_warnings import CaptureWarning
from splinecli.diagnosis.light_check import OPEN_ERROR_DEG, Candidate, LightCheck, mirror_twin
from splinecli.diagnosis.light_order import FEWER_LEFT, HALF_VECTORS, UNKNOWN_ORDER, ZENITH

_WRITES_MENDED = "`splinecli info CAPTURE --mended-lights FILE`"


def light_warnings(
    check: LightCheck, light_file: Path, frame: LightFrame, *, strict: bool = False
) -> list[CaptureWarning]:
    """Return the warnings about lights of a file that was read in a frame, which the advice replaces.

    If `strict`, also warn of what the images do not tell, as they do not of most reliefs without an outline. Each
    warning states the error of the normals.
    """
    warnings = []
    if check.order is not None:
        code = codes.LIGHT_FRAME if check.order in (ZENITH, HALF_VECTORS) else codes.LIGHT_ORDER
        warnings.append(CaptureWarning(code, _order_text(check, light_file), check.error_deg))
    if check.best is not None:
        code = codes.LIGHT_ORDER if check.best.is_order else codes.LIGHT_FRAME
        warnings.append(CaptureWarning(code, _frame_text(check, check.best, frame, light_file), check.error_deg))
    if check.lacks_shadows:
        text = (
            f"Under the lights of {light_file.name}, the surface should cast shadows that are not in the images. With"
            " x and y of the lights negated, bumps become hollows, and fewer shadows are missing. The images do not"
            " decide which is right. Compare bumps and hollows with the object. If they are exchanged, run again with"
            f" --light-frame {BOTH_NEGATED.after(frame)}."
        )
        warnings.append(CaptureWarning(codes.LIGHTS_UNCHECKED, text, OPEN_ERROR_DEG))
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
    elif check.order == HALF_VECTORS:
        remedy = f"Double the angle of each light from the camera axis, as {_WRITES_MENDED} does."
        if check.order_misfit > FEWER_LEFT * check.given_misfit:  # a ring, told by the albedo
            return (
                f"{light_file.name} probably contains half vectors, half-way between the lights and the camera axis:"
                f" under them, steep slopes look brighter. {remedy}"
            )
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
    names = [each.name if each.frame is None else f"with {each.name}" for each in (best, twin) if each is not None]
    text = f"The lights give normals that fit a surface much better {' or '.join(names)}"
    if figures:
        text += f" ({', '.join(figures)})"
    if best.is_order:
        return f"{text}. Check that the lines of {light_file.name} are in the order of the images."
    which = "They exchange hollows and bumps; without a closed outline, only you can tell which is right."
    if best.frame is None:
        return f"{text}. " + (f"Rotate the light directions, as {_WRITES_MENDED} does." if twin is None else which)
    advice = f"{text}: run again with --light-frame {best.frame.after(frame)}"
    if twin is not None and twin.frame is not None:
        return f"{advice} or {twin.frame.after(frame)}. {which}"
    if best.frame.signs == (-1, -1, 1) and not best.frame.exchanged:
        advice += ". If the object is hollow up to its outline, as the inside of a bowl, the lights are right"
    return f"{advice}."
