"""Estimate lights from the images of the object alone (uncalibrated photometric stereo).

The shading of a matte surface leaves its lights ambiguous, so other evidence has to decide. A bump
looks like a hollow under lights with x and y negated: shading, attached shadows, highlights and the
curl of the normals are the same, but cast shadows and the outline differ. In addition, the heights
of a surface may be scaled if its lights are lowered or raised accordingly. This generalised
bas-relief ambiguity preserves all shadows (Belhumeur, Kriegman and Yuille, "The bas-relief
ambiguity", IJCV 1999), but it makes the albedo depend on the slope.

The outline of the object reveals a common rotation of lights and normals; see outline.py.

The lights are estimated in three steps. The light network guesses each light from shading, shadows
and outline, and predicts the error of its guess. Since a matte surface under F lights has images of
rank 3 (Hayakawa, JOSA A 1994) and its normals have no curl, least_curl.py finds further candidates.
Starting from these and from lights near the guess, estimate/light_descent.py searches for lights
under which the network that estimates normals predicts the smallest errors. Cast shadows, the
outline and the light network decide between bump and hollow.
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
from splinecli.maths.pixel_grid import Blocks, on_map, thin_out
from splinecli.maths.robust import fit_robustly, shadow_weights
from splinecli.surface.integration import integrate_normals
from splinecli.system.machine import side_by_side

_FITS = 5
_LEAST_Z = 0.1  # smallest z of normals that are integrated


def bump_log_odds(observations: Float32Array, mask: Bools, light_directions: Float64Array) -> float:
    """Return the log odds of the lights against the same lights with x and y negated.

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

    normals = on_map(unit(scaled), mask)
    normals[..., 2] = np.where(mask, normals[..., 2].clip(min=_LEAST_Z), 0)
    heights = np.where(mask, integrate_normals(unit(normals), mask), np.nan)
    predicted = scaled @ light_directions.T
    # If a pixel is dark although more than this share of its brightest observation is predicted, it
    # is in a cast shadow.
    facing = bright & (predicted > 0.15)
    dark = values[facing] < 0.5 * predicted[facing]
    bump, hollow = (
        _correlation(
            cast_shadows(sign * heights, light_directions * (sign, sign, 1))[mask][facing], dark
        )
        for sign in (1, -1)
    )
    # From a logistic regression on 1,056 rendered captures, of which it misclassifies 1 %, or 3 %
    # without outline.
    return 11.0 * (bump - hollow) + 8.0 * outline


def _correlation(predicted: Bools, seen: Bools) -> float:
    """Return the correlation of two boolean arrays; 0 if one of them is constant."""
    if min(predicted.sum(), (~predicted).sum(), seen.sum(), (~seen).sum()) == 0:
        return 0.0
    return float(np.corrcoef(predicted, seen)[0, 1])


# largest mean expected error of lights, above which the normals would be useless
LARGEST_ERROR_DEG = 25.0
_MOST_PIXELS = 4_000_000  # larger captures are subsampled
_VIEWS = [(turns, mirrored) for turns in range(4) for mirrored in (False, True)]
_OTHER_DEG = 4.0  # searches from lights that differ by less have the same result
_MOST_STARTS = 3
# largest accepted probability that bump and hollow were confused
_MOST_OPPOSITE = 0.25

Search = Callable[..., BestLights]
"""best_lights in estimate/light_descent.py, which uses the network that estimates normals."""


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
    """Return the lights of the images of one object.

    The observations (P, F) are linear, non-negative, and divided by the light intensities if these
    are known; otherwise, the intensities are estimated as well. The mask (H, W) has P true pixels,
    in row-major order. `first_light` is the side that the light of the first observations comes
    from (see azimuth_of), which decides between a bump and a hollow. Without it, cast shadows, the
    outline and the light network decide. `first_image` is the name of the first image in messages.
    If the images do not determine the lights, an error is raised; without `refuse`, a guess is
    returned instead.

    Raises UsageError if the first light is neither a known side nor an azimuth; InputError if the
    images are all alike, do not show one surface, or do not determine the lights.
    """
    step = max(1, math.ceil(math.sqrt(len(observations) / _MOST_PIXELS)))
    observations, mask = thin_out(observations, mask, step)
    _check_different(observations)
    guess, errors_deg, intensities, bump = _ask_network(observations, mask)
    if intensities_known:
        intensities = np.ones_like(intensities)
    by_network, expected_deg = Lights(guess, intensities), float(errors_deg.mean())
    first = _fit(observations, mask, by_network, errors_deg, bump, intensities_known, refuse=refuse)
    starts = [first]
    for each in lights_of_least_curl(
        observations, mask, by_network, errors_deg, intensities_known=intensities_known
    ):
        others = (differ_by_deg(each.directions, start.directions) for start in starts)
        if len(starts) < _MOST_STARTS and min(others) > _OTHER_DEG:
            starts.append(each)
    # The network predicts too large errors for easy objects. Fitted on 170 rendered captures with
    # an earlier one; the 1.2 degrees are for photographs.
    found_deg = math.hypot(0.28 * expected_deg**1.3, 1.2)
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
            bump,
        )
    # If the lights have larger errors, the network that estimates normals also predicts larger
    # errors than the usual 2 degrees. The exponent was fitted on 150 other captures.
    found_deg *= (math.degrees(math.exp(found.expected)) / 2) ** 0.3
    errors_deg = errors_deg * found_deg / expected_deg
    opposite_deg = 2 * np.degrees(np.arccos(directions[:, 2].clip(-1, 1)))
    errors_deg = (1 - opposite_share) * errors_deg + opposite_share * opposite_deg
    if refuse and opposite_share > _MOST_OPPOSITE:
        raise _open_question(mask, first_image)
    if refuse and (expected := float(errors_deg.mean())) > LARGEST_ERROR_DEG:
        raise InputError(
            f"the images do not determine the lights: their estimated error is {expected:.1f}"
            f" degrees, expected at most {LARGEST_ERROR_DEG:.0f}",
            hint="Photograph the whole outline of the object and pass its mask, add images with"
            " other lights, or measure the lights with 'splinecli calibrate'",
        )
    return FoundLights(
        directions, errors_deg, None if intensities_known else intensities / intensities.mean()
    )


def _fit(
    observations: Float32Array,
    mask: Bools,
    guess: Lights,
    errors_deg: Float64Array,
    bump: float,
    intensities_known: bool,
    *,
    refuse: bool,
) -> Lights:
    """Return the lights near the network's guess that fit the images and the outline.

    With `refuse`, raises InputError if no lights explain the images.
    """
    directions, intensities = guess
    observations = np.asarray(observations / intensities, np.float32)
    error = 0.0 if intensities_known else INTENSITY_ERROR
    fit = fit_near(observations, directions, errors_deg, intensity_error=error, worth_pixels=6.0)
    # Largest median residual of one surface, relative to a pixel's brightest observation. Rendered
    # scenes, including metals, reach at most half of this value.
    if refuse and fit is not None and fit.after > 0.08:
        problem = (
            "the images do not show one surface under different distant lights, so the lights"
            " cannot be estimated"
        )
        hint = (
            "Check that the camera and the object did not move, and that all images show the same"
            " object"
        )
        raise InputError(problem, hint=hint)
    if fit is not None and fit.after < fit.before and (fit.directions[:, 2] > 0).all():
        directions, intensities = fit.directions, intensities * fit.intensities
        observations = np.asarray(observations / fit.intensities, np.float32)
    expected_deg = float(errors_deg.mean())
    directions, _ = _bump_or_hollow(
        observations, mask, directions, expected_deg, guess.directions, bump
    )
    turn = turn_at_outline(observations, mask, directions)
    if turn is not None and turn.spread < 0.2:  # outlines of larger spread are ignored
        # Apply a share of the rotation. If it exceeds twice the expected error, the excess is due
        # to an outline such as the mouth of a vessel.
        share = 0.35 * min(1, 2.0 * expected_deg / max(turn.angle_deg, 1e-9))
        turned = directions @ turn.share(share).T
        directions = turned if (turned[:, 2] > 0).all() else directions
    return Lights(directions, intensities)


def _bump_or_hollow(
    observations: Float32Array,
    mask: Bools,
    directions: Float64Array,
    expected_deg: float,
    guess: Float64Array,
    bump: float,
) -> tuple[Float64Array, float]:
    """Return the directions (F, 3) or the opposite ones, whichever is more likely, and the risk of
    error.

    Shadows, the outline, and the network's guess and logit of a bump decide. Opposite directions
    have x and y negated. The risk is the probability that the other directions are right.
    """
    away, opposite = (
        angle_between_deg(directions * sign, guess).mean() for sign in (1.0, OPPOSITE)
    )
    if opposite < away:
        directions = directions * OPPOSITE
    log_odds = bump_log_odds(observations, mask, directions)
    # If the outline is visible, the network seldom confuses bumps with hollows: never on 113
    # rendered captures with expected errors below 14 degrees, but on three of nine above 20.
    # Without an outline, its logit of a bump states how sure it is of either, but does not decide
    # alone, because both may look the same. On 224 rendered captures, it reduced the share of wrong
    # decisions from 12 to 5 %.
    network = max(0.7, 7.0 - 0.25 * expected_deg) if is_outlined(mask) else min(abs(bump), 1.0)
    sign = -1.0 if log_odds + network < 0 else 1.0
    directions = directions * OPPOSITE if sign < 0 else directions
    # A hollow is only certain with other evidence, because the network mistook a ball of an
    # unknown material for one.
    if _looks_hollow(observations, mask, directions):
        network = 0.0
    return directions, 1 / (1 + math.exp(min(sign * (log_odds + network), 500.0)))


def _looks_hollow(observations: Float32Array, mask: Bools, directions: Float64Array) -> bool:
    """Return whether the side of the object opposite to the light is clearly the brighter one."""
    rows, columns = np.nonzero(mask)
    places = np.stack((columns - columns.mean(), rows.mean() - rows), axis=1)
    places /= math.sqrt(len(rows) / math.pi)  # in radii
    values = observations / np.maximum(observations.mean(axis=0), 1e-9)
    values = np.minimum(values, np.quantile(values, 0.995, axis=0))
    shifts = values.T @ places / len(places)
    shifts -= shifts.mean(axis=0)
    sides = directions[:, :2] - directions[:, :2].mean(axis=0)
    scale = np.linalg.norm(shifts) * np.linalg.norm(sides)
    return bool(np.abs(shifts).mean() > 0.05 and (shifts * sides).sum() < -0.7 * scale)


def _open_question(mask: Bools, first_image: str) -> InputError:
    problem = "the images do not show whether the object is a bump or a hollow"
    whole = (
        "If the images show the whole object, pass its mask with --mask FILE or, before a darker"
        " background, add --auto-mask. Otherwise, state"
    )
    return InputError(
        f"{problem}, because both look the same under opposite lights",
        hint=f"{'State' if is_outlined(mask) else whole} where the light of {first_image} comes"
        " from: --first-light left, upper-left, or its azimuth in degrees, counter-clockwise from"
        " the right",
    )


def _towards(directions: Float64Array, first_light: str) -> Float64Array:
    """Return the directions (F, 3) or the opposite ones, whichever has the first light on this
    side.

    Raises InputError if it is not clearly on either side.
    """
    azimuth = math.radians(azimuth_of(first_light))
    towards = float(directions[0, :2] @ (math.cos(azimuth), math.sin(azimuth)))
    # A light must be at least 9 degrees from the camera axis, towards the side.
    if abs(towards) < 0.15:
        problem = (
            f"the first light comes neither clearly from {first_light} nor from the opposite side"
        )
        hint = (
            "Pass its azimuth in degrees, such as --first-light 45, or start with an image that is"
            " lit from one side"
        )
        raise InputError(problem, hint=hint)
    return directions * OPPOSITE if towards < 0 else directions


def _check_different(observations: Float32Array) -> None:
    """Raise InputError if the light is the same in all images."""
    rows = observations[:: max(1, len(observations) // 10_000)].astype(np.float64)
    # A change of exposure is not a change of the light.
    rows = rows / np.maximum(rows.mean(axis=0), 1e-12)
    mean = rows.mean(axis=1, keepdims=True)
    if np.abs(rows - mean).mean() <= 0.01 * mean.mean():  # both are zero for black images
        problem = "all images look the same, so they do not determine the lights"
        raise InputError(problem, hint="Move the lamp to another place for each photograph")


def _ask_network(
    observations: Float32Array, mask: Bools
) -> tuple[Float64Array, Float64Array, Float64Array, float]:
    """Return the network's directions (F, 3), their expected errors (F,) in degrees, intensities
    (F,), and the logit that the object is a bump.

    They are averaged over the four rotations of the images by 90 degrees and their mirror images.
    """
    area, image = torch.from_numpy(mask), np.zeros(mask.shape, np.float32)
    small = []
    for values in observations.T:  # one image at a time, to save memory
        image[mask] = values
        cut, inside = square_images(torch.from_numpy(image)[None], area)
        small.append(cut[0])
    if not inside.any():
        raise InputError(
            "the mask is too thin or too scattered to estimate the lights",
            hint="Pass a mask of the whole object",
        )
    images = torch.stack(small)
    images = images / images[:, inside > 0].quantile(0.99).clamp(min=1e-9)
    network = light_net()
    # Each view runs in one thread, so that the number of threads does not affect rounding.
    guesses = [*side_by_side(lambda view: _view(network, images, inside, *view), _VIEWS)]
    directions, sharpness, log_intensities, bump = (
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
        float(bump.mean()),
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
