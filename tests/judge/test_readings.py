"""Encoded values, near lamps, constant light and wrong intensities, found in scenes of known curve,
lamps and light.
"""

import numpy as np
from numpy.typing import NDArray
from pytest import approx

from judged import warnings_of
from scenes import as_capture, parametrize, ring_lights, shade, spiral_lights, square_grid, tilted
from scenes import sphere as ball
from splinecli.capture.near_lamps import NearLamps
from splinecli.images.lamps import estimate_light_intensities
from splinecli.maths.normals import angle_between_deg, unit

Array = NDArray[np.float64]
SIZE = 48
TWO_RINGS = np.concatenate((ring_lights(6, 55, 0.3), ring_lights(4, 30)))
LIGHTS = {
    "two rings": TWO_RINGS,
    "one ring": ring_lights(8, 45, 0.2),
    "spiral": spiral_lights(10, 52, 15),
}
CODES = {"nonlinearity_suspected", "near_lights_suspected", "constant_light", "unequal_intensities"}


def surface(shape):
    """Return normals (P, 3) and the mask (SIZE, SIZE) of a ball, of bumps over the picture, or of a
    tilted plate.
    """
    x, y = square_grid(SIZE)
    if shape == "ball":
        normals, mask = ball(SIZE, 0.95)
        return normals[mask], mask
    slopes = {"bumps": (0.5 * np.cos(5 * x) * np.cos(4 * y), -0.4 * np.sin(5 * x) * np.sin(4 * y))}
    across = slopes.get(shape, (0.3 + 0 * x, 0.15 + 0 * x))
    return tilted(*across).reshape(-1, 3), np.ones(x.shape, np.bool_)


def values(shape, lights, *, gloss=0.0, constant=0.0, noise=0.002):
    """Return observations (P, F), the largest 1, of a surface with a random albedo, also under
    constant light.
    """
    normals, _ = surface(shape)
    rng, matte = np.random.default_rng(3), shade(normals, lights)
    shaded = (
        rng.uniform(0.5, 1, (len(normals), 1)) * (matte + constant)
        + shade(normals, lights, gloss=gloss)
        - matte
    )
    return np.asarray((shaded / shaded.max() + rng.normal(0, noise, shaded.shape)).clip(0, 1))


def encode(linear, bits=16):
    srgb = np.where(
        linear < 0.0031308, 12.92 * linear, 1.055 * linear.clip(1e-9) ** (1 / 2.4) - 0.055
    )
    return np.rint(srgb * (2**bits - 1)) / (2**bits - 1)


def found(shape, observed, lights, intensities=None):
    if intensities is not None:
        observed = observed / intensities
    capture = as_capture(observed, lights, surface(shape)[1])
    return [
        warning
        for warning in warnings_of(capture, intensities=intensities)
        if warning.code in CODES
    ]


def error_of(observed, lights, shape):
    """Return the mean error of the brightest pixels' least squares, which is what the wrong reading
    costs.
    """
    lit = (observed > 0.02).all(axis=1)
    fitted = unit(np.linalg.lstsq(lights, observed[lit].T, rcond=None)[0].T)
    return float(np.median(angle_between_deg(fitted, surface(shape)[0][lit])))


@parametrize("lights", LIGHTS)
@parametrize("shape", "ball bumps plate")
@parametrize("gloss", [0.0, 0.2])
def test_right_captures_are_not_doubted(shape, lights, gloss):
    assert found(shape, values(shape, LIGHTS[lights], gloss=gloss), LIGHTS[lights]) == []


@parametrize(
    ("shape", "lights"),
    [*(("ball", lights) for lights in LIGHTS), ("bumps", "two rings"), ("bumps", "spiral")],
)
@parametrize("known", [False, True])
def test_encoded_values(shape, lights, known):
    directions = LIGHTS[lights]
    intensities = np.linspace(0.7, 1.3, len(directions)) if known else None
    linear = values(shape, directions) * (1 if intensities is None else intensities)
    (warning,) = found(shape, encode(linear / linear.max()), directions, intensities)
    assert warning.code == "nonlinearity_suspected" and "--transfer srgb" in warning.text
    if not known:
        assert warning.error_deg == approx(error_of(encode(linear), directions, shape), rel=0.35)


@parametrize("exponent", [1.0, 1.25])
def test_a_weak_curve_is_not_decided(exponent):
    directions = LIGHTS["two rings"]
    observed = values("ball", directions) ** (1 / exponent)
    warnings = warnings_of(as_capture(observed, directions, surface("ball")[1]))
    undecided = [each for each in warnings if each.code == "reading_undecided"]
    assert ["a transfer curve (" in each.text for each in undecided] == [True] * (exponent > 1)
    most_deg = 2 * error_of(observed, directions, "ball")
    assert all(1 <= each.error_deg < most_deg for each in undecided)


@parametrize("lights", LIGHTS)
def test_a_flat_object_is_not_accused_of_another_fault(lights):
    """Its pixels repeat each other, so that its images hardly determine how to read them."""
    directions = LIGHTS[lights]
    linear = values("plate", directions)
    for observed in (encode(linear / linear.max()), values("plate", directions, constant=0.2)):
        assert found("plate", observed, directions) == []


def test_a_curve_behind_unequal_lamps():
    intensities = np.array([0.5, 1.0, 1.6, 0.8, 1.2, 0.7, 1.4, 0.9, 1.1, 0.6])
    linear = values("ball", LIGHTS["spiral"]) * intensities
    directions = LIGHTS["spiral"]
    for observed, expected in (
        (linear, set()),
        (encode(linear / linear.max()), {"nonlinearity_suspected"}),
    ):
        estimated = estimate_light_intensities(np.float32(observed), None, directions)
        capture = as_capture(
            observed / estimated, directions, surface("ball")[1], estimated_intensities=estimated
        )
        assert CODES & {warning.code for warning in warnings_of(capture)} == expected


@parametrize("widths", [1.5, 2.0, 3.0, 4.0])
@parametrize("shape", "ball bumps plate")
def test_near_lamps(shape, widths):
    directions, (normals, mask) = LIGHTS["spiral"], surface(shape)
    lamps = NearLamps.of(
        directions * widths * np.ptp(np.flatnonzero(mask.any(axis=0))), 1.0, mask.shape, equal=True
    )
    towards, attenuations = lamps.light_at(lamps.plane_points(*np.nonzero(mask)))
    shaded = np.einsum("pfc,pc->pf", towards * attenuations[..., None], normals).clip(0)
    (warning,) = found(shape, shaded / shaded.max(), directions)
    assert warning.code == "near_lights_suspected" and warning.error_deg is not None
    # An error of a quarter of the distance costs 2 to 4 degrees, where distant lights cost 6 to 20.
    stated = float(warning.text.split("--light-distance ")[1].split()[0])
    assert stated == approx(widths, rel=0.26)


@parametrize("lights", LIGHTS)
@parametrize("share", [0.2, 1.0])
def test_constant_light(lights, share):
    (warning,) = found("ball", values("ball", LIGHTS[lights], constant=share), LIGHTS[lights])
    assert warning.code == "constant_light" and "--ambient" in warning.text


@parametrize("lights", ["two rings", "spiral"])
def test_a_relief_under_constant_light_looks_translucent(lights):
    """Light that enters a material softens its shading in the same way."""
    directions = LIGHTS[lights]
    observed = values("bumps", directions, constant=0.2)
    capture = as_capture(observed, directions, surface("bumps")[1])
    (warning,) = [each for each in warnings_of(capture) if each.code != "few_lights"]
    assert warning.code == "unknown_material" and warning.error_deg


def test_constant_light_under_four_lights():
    lights = ring_lights(4, 45)
    (warning,) = found("ball", values("ball", lights, constant=6, noise=0.0005), lights)
    assert warning.code == "constant_light" and (warning.error_deg or 0) > 20


@parametrize(
    ("words", "given"),
    [
        ("inverted", lambda e: 1 / e),
        ("in reversed order", lambda e: e[::-1]),
        ("left out", lambda e: np.ones_like(e)),
    ],
)
def test_wrong_intensities(words, given):
    intensities = np.array([0.8, 1.0, 1.2, 0.8, 1.1, 0.7, 1.3, 0.9, 1.1, 0.95])
    truth = np.ones(10) if words == "left out" else intensities
    stated = intensities if words == "left out" else given(intensities)
    observed = values("ball", LIGHTS["spiral"]) * truth
    assert found("ball", observed, LIGHTS["spiral"], truth) == []
    (warning,) = found("ball", observed, LIGHTS["spiral"], stated)
    assert warning.code == "unequal_intensities" and words in warning.text


def test_too_little_is_not_judged():
    few, black = values("bumps", LIGHTS["spiral"])[:30], np.zeros((400, 10))
    for observed, shape in ((few, (5, 6)), (black, (20, 20))):
        capture = as_capture(observed, LIGHTS["spiral"], np.ones(shape, np.bool_))
        assert not CODES & {warning.code for warning in warnings_of(capture)}


def test_clipped_values_are_no_curve():
    lights = LIGHTS["spiral"]
    assert found("ball", np.minimum(values("ball", lights), 0.75), lights, np.ones(10)) == []
