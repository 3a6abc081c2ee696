"""Transfer curves between linear and stored values: sRGB (IEC 61966-2-1), gamma curves, tables, and
curves from ICC profiles (ISO 15076-1).
"""

import re
import struct
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import UsageError, did_you_mean
from splinecli.maths import Float32Array, Float64Array, Floats

_LINEAR_BELOW = 0.0031308  # linear value below which the sRGB curve is linear

# Use the curve stated by the images, which is the colour profile's curve, sRGB for JPEG files and
# PNG files that state it, and linear otherwise.
AUTOMATIC = "auto"
# An exponent (1 is linear), None for sRGB, or a table of the linear values of evenly spaced stored
# values from 0 to 1
TransferCurve = float | tuple[float, ...] | None
SRGB: TransferCurve = None
_CODES = np.linspace(0, 1, 256)
# The curve of most videos (ITU-R BT.709) for 8-bit values
BT709: TransferCurve = tuple(
    np.where(_CODES < 0.081, _CODES / 4.5, ((_CODES + 0.099) / 1.099) ** (1 / 0.45)).tolist()
)
GAMMAS = 0.1, 10.0  # the smallest and the largest exponent


def encode_srgb(linear: Floats) -> NDArray[np.uint8]:
    """Return linear values as 8-bit sRGB. Values outside 0 to 1 are clipped."""
    values = np.clip(linear, 0, 1)
    power = 1.055 * np.maximum(values, _LINEAR_BELOW) ** (1 / 2.4) - 0.055
    return np.asarray(
        np.rint(255 * np.where(values <= _LINEAR_BELOW, 12.92 * values, power)), np.uint8
    )


def parse_transfer(text: str) -> float | None:
    """Return the transfer curve with this name.

    It is G for "gamma:G", 1 for "linear" and AUTOMATIC, and None for "srgb". Raises UsageError if
    the name is unknown, or if G is not between 0.1 and 10.
    """
    named: dict[str, float | None] = {AUTOMATIC: 1.0, "linear": 1.0, "srgb": None}
    if text in named:
        return named[text]
    if match := re.fullmatch(r"gamma:([0-9.]+)", text):
        try:
            gamma = float(match[1])
        except ValueError:
            gamma = 0.0
        if GAMMAS[0] <= gamma <= GAMMAS[1]:
            return gamma
    raise UsageError(
        f"the transfer curve is {text!r}; expected auto, linear, srgb, or gamma:G with G from 0.1"
        " to 10",
        hint=did_you_mean(text, named),
    )


def decode_transfer(stored: Float32Array, curve: TransferCurve) -> Float32Array:
    """Return linear values for stored values from 0 to 1."""
    if curve == 1:
        return stored
    if isinstance(curve, tuple):
        return np.interp(stored, np.linspace(0, 1, len(curve)), curve).astype(np.float32)
    if curve is not None:
        return np.asarray(stored**curve, np.float32)
    power = ((stored + 0.055) / 1.055) ** 2.4
    return np.where(stored <= 12.92 * _LINEAR_BELOW, stored / 12.92, power).astype(np.float32)


# Size limit of a profile in bytes. Profiles of cameras and screens have a few kilobytes.
LARGEST_PROFILE = 1 << 22
_SAMPLES = 4096  # of a curve without a name
_SAME = 1e-3  # difference of linear values below which two curves are considered equal


@lru_cache(maxsize=4)
def profile_curve(profile: bytes) -> tuple[str, TransferCurve] | None:
    """Return the name and the curve of a profile, or None if it is damaged or has no single
    curve.
    """
    try:
        if profile[36:40] != b"acsp" or profile[16:20] not in (b"RGB ", b"GRAY"):
            return None
        (count,) = struct.unpack_from(">I", profile, 128)
        places = [
            struct.unpack_from(">4sII", profile, 132 + 12 * i) for i in range(min(count, 100))
        ]
        tags = {name: profile[start : start + length] for name, start, length in places}
        curves = [
            _curve(tags[name]) for name in (b"kTRC", b"rTRC", b"gTRC", b"bTRC") if name in tags
        ]
        name = _text(tags[b"desc"]) if b"desc" in tags else ""
    except (struct.error, ValueError, IndexError, OverflowError):
        return None
    stored = np.linspace(0, 1, _SAMPLES, dtype=np.float32)
    sampled = [decode_transfer(stored, curve) for curve in curves]
    if not curves or any(np.abs(one - sampled[0]).max() > _SAME for one in sampled):
        return None
    named = (
        curve
        for curve in (1.0, SRGB)
        if np.abs(decode_transfer(stored, curve) - sampled[0]).max() < _SAME
    )
    return name, next(named, curves[0])


def _curve(tag: bytes) -> TransferCurve:
    """Return the curve of a tag `curv` or `para`. Raises ValueError or struct.error if it has no
    usable curve.
    """
    stored = np.linspace(0, 1, _SAMPLES)
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count < 2:
            return _checked_gamma(struct.unpack_from(">H", tag, 12)[0] / 256 if count else 1.0)
        table = np.frombuffer(tag, ">u2", count, 12) / 65535
        linear = np.interp(stored, np.linspace(0, 1, count), table)
    elif tag[:4] == b"para":
        (kind,) = struct.unpack_from(">H", tag, 8)
        given = np.frombuffer(tag, ">i4", (1, 3, 4, 5, 7)[kind], 12) / 65536
        if kind == 0:
            return _checked_gamma(given[0])
        linear = _parametric(stored, given.tolist())
    else:
        raise ValueError
    if not (np.isfinite(linear).all() and (np.diff(linear) >= 0).all() and linear[-1] > linear[0]):
        raise ValueError
    return tuple(linear.clip(0, 1).tolist())


def _parametric(stored: Float64Array, given: list[float]) -> Float64Array:
    """Return the linear values of a parametric curve with 3, 4, 5 or 7 parameters, in the order of
    the standard.
    """
    g, a, b = given[:3]
    if a <= 0:
        raise ValueError
    c, d, e, f = {3: (0.0, -b / a, 0.0, 0.0), 4: (0.0, -b / a, *(2 * given[3:4]))}.get(
        len(given), (*given[3:5], *(given[5:] or (0.0, 0.0)))
    )
    with np.errstate(over="ignore", divide="ignore"):
        power = np.maximum(a * stored + b, 0) ** g + e
    return np.asarray(np.where(stored >= d, power, c * stored + f))


def _checked_gamma(gamma: float) -> float:
    if not GAMMAS[0] <= gamma <= GAMMAS[1]:
        raise ValueError
    return round(float(gamma), 4)


def _text(tag: bytes) -> str:
    """Return the printable characters of a description, in the form of version 2 or 4."""
    if tag[:4] == b"mluc":
        length, start = struct.unpack_from(">II", tag, 20)
        text = tag[start : start + length].decode("utf-16-be", "replace")
    else:
        (length,) = struct.unpack_from(">I", tag, 8)
        text = tag[12 : 12 + length].decode("ascii", "replace")
    return "".join(character for character in text[:60] if character.isprintable())
