"""Lights from the images of the object alone (uncalibrated photometric stereo), and how to resolve
the ambiguities.

The shading of a matte surface leaves its lights ambiguous, so other evidence has to decide. A bump
looks like a hollow under lights with x and y negated: shading, attached shadows and highlights are
equal, and so is the curl of the normals. Cast shadows and the outline differ. In addition, the
heights of a surface may be scaled if its lights are lowered or raised with them. This generalised
bas-relief ambiguity keeps all shadows (Belhumeur, Kriegman and Yuille, "The bas-relief ambiguity",
IJCV 1999), but the albedo then changes with the slope.

The outline of the object shows a common rotation of lights and normals; see outline.py.

Three witnesses find the lights. The light network guesses each light from shading, shadows and
outline, and predicts the error of its guess. A matte surface under F lights has images of rank 3
(Hayakawa, JOSA A 1994), and its normals have no curl: see least_curl.py. Lights near the guess and
lights of least curl then start a search for those under which the network that estimates normals
expects the smallest errors: see estimate/light_descent.py. Cast shadows and the outline decide
between bump and hollow.
"""

import math
from collections.abc import Callable

import numpy as np
import torch

from splinecli.capture.record import FoundLights, azimuth_of
from splinecli.errors import InputError
from splinecli.lights.least_curl import (
    OPPOSITE,
    BestLights,
    Lights,
    differ_by_deg,
    lights_of_least_curl,
)
from splinecli.lights.light_fit import INTENSITY_ERROR, fit_near
from splinecli.lights.light_net import (
    LightGuess,
    LightNet,
    light_net,
    network_inputs,
    square_images,
)
from splinecli.lights.outline import DARK_SHARE, is_outlined, turn_at_outline
from splinecli.lights.rough_normals import cast_shadows, smooth_normals
from splinecli.maths import Bools, Float32Array, Float64Array
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.pixel_grid import Blocks
from splinecli.maths.robust import fit_robustly, lit_values, shadow_weights
from splinecli.surface.integration import integrate_normals
from splinecli.system.machine import side_by_side

_FITS = 5
_LEAST_Z = 0.1  # of normals that are integrated
# logarithms of the factors of the heights of the lights that are tried
_LOG_HEIGHTS = np.arange(-1.2, 0.05, 0.1)
_ALBEDO_BINS = 41  # of 0.1, of the logarithm of the albedo


def bump_log_odds(observations: Float32Array, mask: Bools, light_directions: Float64Array) -> float:
    """Return the log odds that the lights are right against that their x and y are negated.

    The observations (P, F) are linear, divided by the light intensities. The mask (H, W) has P true
    pixels, in row-major order, and the directions (F, 3) are unit.
    """
    blocks = Blocks.over(mask, 1200)
    values, mask = blocks.average(observations, mask).astype(np.float64), blocks.mask
    brightest = values.max(axis=1, keepdims=True)
    bright = brightest > DARK_SHARE * np.quantile(brightest, 0.99)
    values /= np.maximum(brightest, 1e-12)
    scaled, _ = fit_robustly(values, shadow_weights(values), light_directions, _FITS)
    rough = smooth_normals(scaled, mask)
    rim = rough.rim()
    outline = 0.0 if np.isnan(rim) else rim * rough.rim_steepness

    normals = np.zeros((*mask.shape, 3))
    normals[mask] = unit(scaled)
    normals[..., 2] = np.where(mask, normals[..., 2].clip(min=_LEAST_Z), 0)
    heights = np.where(mask, integrate_normals(unit(normals), mask), np.nan)
    predicted = scaled @ light_directions.T
    # Where so much is predicted of a pixel's brightest observation, darkness is a cast shadow.
    facing = bright & (predicted > 0.15)
    dark = values[facing] < 0.5 * predicted[facing]
    bump, hollow = (
        _correlation(
            cast_shadows(sign * heights, light_directions * (sign, sign, 1))[mask][facing], dark
        )
        for sign in (1, -1)
    )
    # Logistic regression on 1,056 rendered captures, on which it errs in 1 % of the decisions, or 3
    # % without outline.
    return 11.0 * (bump - hollow) + 8.0 * outline


def _correlation(predicted: Bools, seen: Bools) -> float:
    """Return the correlation of two sets; 0 if one has all or none."""
    if min(predicted.sum(), (~predicted).sum(), seen.sum(), (~seen).sum()) == 0:
        return 0.0
    return float(np.corrcoef(predicted, seen)[0, 1])


def lower_lights(
    observations: Float32Array, light_directions: Float64Array, error_deg: float
) -> Float64Array:
    """Return low lights (F, 3), lowered together towards those under which the albedo has few
    values; others as given.

    The entropy of the albedo is minimised (Alldrin, Mallick and Kriegman, "Resolving the
    generalized bas-relief ambiguity by entropy minimization", CVPR 2007). Lights are only lowered,
    because the network's errors are upwards. The observations (P, F) are linear, divided by the
    light intensities; `error_deg` is the mean expected error.
    """
    # The network finds lower lights too high.
    if np.degrees(np.arcsin(light_directions[:, 2].clip(-1, 1))).mean() > 55.0:
        return light_directions
    chosen, values = lit_values(observations, DARK_SHARE, 2000)
    lit = values > 0.1 * np.quantile(values, 0.6, axis=1, keepdims=True)
    scaled, _ = fit_robustly(values, lit.astype(np.float64), light_directions, _FITS)
    known = (lit.sum(axis=1) > 3) & (unit(scaled)[:, 2] > _LEAST_Z)
    scaled = (scaled * observations[chosen].max(axis=1)[:, None])[known]
    if len(scaled) < _ALBEDO_BINS:
        return light_directions
    # entropy per square of this logarithm and of the expected error in degrees
    prior = 49.0 / error_deg**2
    costs = [_entropy(scaled / (1, 1, np.exp(log))) + prior * log**2 for log in _LOG_HEIGHTS]
    return np.asarray(unit(light_directions * (1, 1, np.exp(_LOG_HEIGHTS[int(np.argmin(costs))]))))


def _entropy(scaled_normals: Float64Array) -> float:
    """Return the entropy of the logarithms of the lengths of vectors (p, 3), relative to their
    median.
    """
    albedo = np.log(np.linalg.norm(scaled_normals, axis=1))
    places = np.rint((albedo - np.median(albedo)) / 0.1) + _ALBEDO_BINS // 2
    counts = np.bincount(places.clip(0, _ALBEDO_BINS - 1).astype(int), minlength=_ALBEDO_BINS)
    shares = np.convolve(counts / len(albedo), (0.25, 0.5, 0.25))
    return float(-(shares[shares > 0] * np.log(shares[shares > 0])).sum())


# mean expected error of lights; larger ones are refused, as their normals would be useless
LARGEST_ERROR_DEG = 25.0
_MOST_PIXELS = 4_000_000  # of a larger capture, some rows and columns are left out
_VIEWS = [(turns, mirrored) for turns in range(4) for mirrored in (False, True)]
_OTHER_DEG = 4.0  # lights that differ by less lead a search to the same lights
_MOST_STARTS = 3
# largest probability that bump and hollow were confused; captures with a larger one are refused
_MOST_OPPOSITE = 0.25

Search = Callable[..., BestLights]
"""See best_lights in estimate/light_descent.py, which uses the network that estimates normals."""


def find_lights(
    observations: Float32Array,
    mask: Bools,
    intensities_known: bool,
    search: Search,
    *,
    first_light: str | None = None,
    first_image: str = "the first image",
    refuse: bool = True,
) -> FoundLights:
    """Find the lights of the images of one object.

    The observations (P, F) are linear, 0 or more, and divided by the light intensities if they are
    known; otherwise, these are estimated as well. The mask (H, W) has P true pixels, in row-major
    order. `first_light` is the side that the light of the first observations comes from, see
    azimuth_of; it decides between a bump and a hollow. Without it, shadows and the outline decide.
    Messages call the first image `first_image`. If the images do not determine the lights, an error
    is raised, or without `refuse` a guess is returned.

    Raises UsageError if the first light is neither a known side nor an azimuth; InputError if the
    images are all alike, do not show one surface, or do not determine the lights.
    """
    step = max(1, math.ceil(math.sqrt(len(observations) / _MOST_PIXELS)))
    if step > 1:
        grid = np.zeros_like(mask)
        grid[::step, ::step] = mask[::step, ::step]
        observations, mask = observations[grid[mask]], mask[::step, ::step]
    _check_different(observations)
    guess, errors_deg, intensities = _ask_network(observations, mask)
    if intensities_known:
        intensities = np.ones_like(intensities)
    by_network, expected_deg = Lights(guess, intensities), float(errors_deg.mean())
    first = _fit(observations, mask, by_network, errors_deg, intensities_known, refuse=refuse)
    starts = [first]
    for each in lights_of_least_curl(
        observations, mask, by_network, errors_deg, intensities_known=intensities_known
    ):
        others = (differ_by_deg(each.directions, start.directions) for start in starts)
        if len(starts) < _MOST_STARTS and min(others) > _OTHER_DEG:
            starts.append(each)
    found_deg = _usual_error_deg(expected_deg, outlined=is_outlined(mask))
    found = search(
        observations,
        mask,
        starts,
        guess,
        errors_deg,
        errors_deg * found_deg / expected_deg,
        intensities_known=intensities_known,
    )
    directions, intensities = found.lights
    opposite_share = 0.0
    if first_light is not None:
        directions = _towards(directions, first_light)
    else:
        directions, opposite_share = _bump_or_hollow(
            np.asarray(observations / intensities, np.float32),
            mask,
            directions,
            max(expected_deg, differ_by_deg(directions, guess)),
            guess,
        )
    # Fitted on 150 other captures: under lights with larger errors, the network that estimates
    # normals expects larger ones, too, usually 2 degrees.
    found_deg *= (math.degrees(math.exp(found.expected)) / 2) ** 0.3
    errors_deg = errors_deg * found_deg / expected_deg
    opposite_deg = 2 * np.degrees(np.arccos(directions[:, 2].clip(-1, 1)))
    errors_deg = (1 - opposite_share) * errors_deg + opposite_share * opposite_deg
    if refuse and opposite_share > _MOST_OPPOSITE:
        raise _open_question(mask, first_image)
    if refuse and (expected := float(errors_deg.mean())) > LARGEST_ERROR_DEG:
        raise InputError(
            f"the images do not determine the lights: their estimated error is {expected:.0f}"
            f" degrees, expected at most {LARGEST_ERROR_DEG:.0f}",
            hint="Show the whole outline of the object and give its mask, add images with"
            " other lights, or measure the lights with 'splinecli calibrate'",
        )
    return FoundLights(
        directions, errors_deg, None if intensities_known else intensities / intensities.mean()
    )


def _usual_error_deg(expected_deg: float, *, outlined: bool) -> float:
    """Return the mean error of fitted lights from the error that the network expects.

    It was fitted on 720 rendered captures: the network expects too much of easy objects. The 1.2
    degrees are for photographs.
    """
    return math.hypot(0.39 * expected_deg**1.3 if outlined else 0.65 * expected_deg, 1.2)


def _fit(
    observations: Float32Array,
    mask: Bools,
    guess: Lights,
    errors_deg: Float64Array,
    intensities_known: bool,
    *,
    refuse: bool,
) -> Lights:
    """Return the lights near the network's guess that fit the images, the outline and the albedo.

    Raises InputError if `refuse`, and no lights explain the images.
    """
    directions, intensities = guess
    observations = np.asarray(observations / intensities, np.float32)
    error = 0.0 if intensities_known else INTENSITY_ERROR
    fit = fit_near(observations, directions, errors_deg, intensity_error=error, worth_pixels=6.0)
    # Largest median residual of a matte surface, as a share of a pixel's brightest observation.
    # Rendered scenes, including metals, reach at most half of this value.
    if refuse and fit is not None and fit.after > 0.08:
        problem = (
            "the images do not show one surface under different distant lights, so the lights"
            " cannot be found"
        )
        hint = "Check that camera and object stood still, and that all images show the same object"
        raise InputError(problem, hint=hint)
    if fit is not None and fit.after < fit.before and (fit.directions[:, 2] > 0).all():
        directions, intensities = fit.directions, intensities * fit.intensities
        observations = np.asarray(observations / fit.intensities, np.float32)
    expected_deg = float(errors_deg.mean())
    directions, _ = _bump_or_hollow(observations, mask, directions, expected_deg, guess.directions)
    turn = turn_at_outline(observations, mask, directions)
    if turn is not None and turn.spread < 0.2:  # outlines of larger spread are ignored
        # A share of the rotation that it shows. The part of a larger one beyond twice the expected
        # error comes from the mouth of a vessel.
        share = 0.35 * min(1, 2.0 * expected_deg / max(turn.angle_deg, 1e-9))
        turned = directions @ turn.share(share).T
        directions = turned if (turned[:, 2] > 0).all() else directions
    return Lights(lower_lights(observations, directions, expected_deg), intensities)


def _bump_or_hollow(
    observations: Float32Array,
    mask: Bools,
    directions: Float64Array,
    expected_deg: float,
    guess: Float64Array,
) -> tuple[Float64Array, float]:
    """Return the directions (F, 3), or those with opposite x and y, whichever shadows, outline and
    the network's guess make more likely, and the probability that the other ones are right.
    """
    away, opposite = (
        angle_between_deg(directions * sign, guess).mean() for sign in (1.0, OPPOSITE)
    )
    if opposite < away:
        directions = directions * OPPOSITE
    log_odds = bump_log_odds(observations, mask, directions)
    # The network seldom confuses bumps with hollows if it sees the outline: never on 113 rendered
    # captures with expected errors below 14 degrees, three times in nine above 20. Without outline,
    # it is wrong as often as right.
    if is_outlined(mask):
        log_odds += max(0.7, 7.0 - 0.25 * expected_deg)
    directions = directions * OPPOSITE if log_odds < 0 else directions
    return directions, 1 / (1 + math.exp(min(abs(log_odds), 500.0)))


def _open_question(mask: Bools, first_image: str) -> InputError:
    problem = "the images do not show whether the object is a bump or a hollow"
    whole = "If the images show the whole object, give its mask with --mask FILE. Else say"
    return InputError(
        f"{problem}, which looks alike under opposite lights",
        hint=f"{'Say' if is_outlined(mask) else whole} where the light of {first_image} comes from:"
        " --first-light left, upper-left, or its azimuth in degrees, counter-clockwise from the"
        " right",
    )


def _towards(directions: Float64Array, first_light: str) -> Float64Array:
    """Return the directions (F, 3), or those with opposite x and y, whichever has the first light
    on this side.

    Raises InputError if it is not clearly on either side.
    """
    azimuth = math.radians(azimuth_of(first_light))
    towards = float(directions[0, :2] @ (math.cos(azimuth), math.sin(azimuth)))
    # Smallest share of a direction towards a side from which a light comes: 9 degrees from the
    # camera axis.
    if abs(towards) < 0.15:
        problem = (
            f"the first light comes neither clearly from {first_light} nor from the opposite side"
        )
        hint = (
            "Give its azimuth in degrees, such as --first-light 45, or begin with an image that is"
            " lit from one side"
        )
        raise InputError(problem, hint=hint)
    return directions * OPPOSITE if towards < 0 else directions


def _check_different(observations: Float32Array) -> None:
    """Raise InputError if the light does not change between the images."""
    rows = observations[:: max(1, len(observations) // 10_000)].astype(np.float64)
    # a change of exposure is not a change of the light
    rows = rows / np.maximum(rows.mean(axis=0), 1e-12)
    mean = rows.mean(axis=1, keepdims=True)
    # Images that differ by less from their mean do not show a moving light.
    if np.abs(rows - mean).mean() <= 0.01 * mean.mean():  # equal for black images
        problem = "all images are alike, so they do not determine the lights"
        raise InputError(
            problem, hint="Photograph the object with the lamp at a different place for each image"
        )


def _ask_network(
    observations: Float32Array, mask: Bools
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the directions (F, 3), their expected errors (F,) in degrees and the intensities (F,).

    They are means over the four rotations of the images by 90 degrees and their mirror images.
    """
    area, image = torch.from_numpy(mask), np.zeros(mask.shape, np.float32)
    small = []
    for values in observations.T:  # one image at a time: all of them would double the memory
        image[mask] = values
        cut, inside = square_images(torch.from_numpy(image)[None], area)
        small.append(cut[0])
    if not inside.any():
        raise InputError(
            "the mask is too thin or too scattered to find the lights",
            hint="Give a mask of the whole object",
        )
    images = torch.stack(small)
    images = images / images[:, inside > 0].quantile(0.99).clamp(min=1e-9)
    network = light_net()
    # One thread each, so that the number of threads does not change the rounding.
    guesses = [*side_by_side(lambda view: _view(network, images, inside, *view), _VIEWS)]
    directions, sharpness, log_intensities, _ = (
        torch.cat(part).double() for part in zip(*guesses, strict=True)
    )
    towards = (sharpness.exp()[..., None] * directions).sum(dim=0)
    mean = torch.nn.functional.normalize(towards, dim=-1)
    between = (directions * mean).sum(dim=-1).clamp(-1, 1).acos().square().mean(dim=0)
    own = (math.pi / 2 / sharpness.exp()).mean(dim=0)  # mean square errors of normal distributions
    return (
        mean.numpy(),
        (own + between).sqrt().rad2deg().numpy(),
        log_intensities.mean(dim=0).exp().numpy(),
    )


def _view(
    network: LightNet, images: torch.Tensor, inside: torch.Tensor, turns: int, mirrored: bool
) -> LightGuess:
    """Return the network's guess for rotated, then mirrored images, in the frame of the original
    images.
    """
    images, inside = torch.rot90(images, turns, (1, 2)), torch.rot90(inside, turns, (0, 1))
    if mirrored:
        images, inside = images.flip(2), inside.flip(1)
    guess: LightGuess = network(network_inputs(images, inside)[None])
    x, y, z = guess.directions.unbind(dim=-1)
    x = -x if mirrored else x
    for _ in range(turns):
        x, y = y, -x
    return guess._replace(directions=torch.stack((x, y, z), dim=-1))
