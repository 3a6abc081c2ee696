"""Lights from the images of the object alone: uncalibrated photometric stereo.

The light network guesses each light from shading, shadows and outline, with an error that it expects. The images then
decide what they can: a matte surface under F lights has images of rank 3 (Hayakawa, JOSA A 1994), so the lights are
moved together until such a surface explains the images, within the guesses and their errors. What the shading of a
matte surface leaves open is decided by cast shadows, the outline and the albedo; see ambiguities.py.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.capture.lights.found_lights import FoundLights, azimuth_of
from splinecli.capture.restore.light_refinement import INTENSITY_ERROR, fit_near
from splinecli.errors import InputError
from splinecli.light.ambiguities import bump_log_odds, lower_lights
from splinecli.light.outline import outline_share, turn_at_outline
from splinecli.networks.light_net import LightGuess, LightNet, network_inputs, square_images
from splinecli.networks.weights import light_net
from splinecli.system.machine import side_by_side

LARGEST_ERROR_DEG = 20.0
"""Lights with a larger expected error on average are refused: their normals would be worth little."""

LARGEST_MISFIT = 0.08
"""Largest median residual of a matte surface, as a share of a pixel's brightest observation. Rendered scenes, metals
among them, have at most half of it."""

LEAST_OUTLINE = 0.5
"""Smallest share of the mask's boundary inside the image. With less, the object continues outside of it."""

LEAST_SIDE = 0.15
"""Smallest share of a direction towards a side from which a light comes: 9 degrees from the camera axis."""

SAME_IMAGES = 0.01  # images that differ by less from their mean, as a share of it, show no light that moves

# Chosen on rendered scenes that the network was not trained on.
_WORTH_PIXELS = 6.0  # see fit_near
_CLEAR_OUTLINE = 0.2  # largest spread of an outline that counts
_OUTLINE_SHARE = 0.35  # of the turn that it shows
_LARGEST_TURN = 2.0  # times the expected error; what a larger turn has beyond it comes from the mouth of a vessel
# Log odds that the network takes a bump for a bump: fewer where it expects larger errors.
_MOST_LOG_ODDS, _LOG_ODDS_PER_DEG, _FEWEST_LOG_ODDS = 7.0, 0.25, 1.0
# The mean error of what is returned from that which the network expects, on 720 rendered captures with and without an
# outline: it expects too much of easy objects. The third is added in quadrature, for photographs.
_ERROR_SCALE, _ERROR_POWER, _LEAST_ERROR_DEG = 0.39, 1.3, 1.2
_ERROR_SHARE = 0.65  # without an outline
_MOST_PIXELS = 4_000_000  # of a larger capture, some rows and columns are left out
_VIEWS = [(turns, mirrored) for turns in range(4) for mirrored in (False, True)]


def find_lights(
    observations: NDArray[np.float32],
    mask: NDArray[np.bool_],
    intensities_known: bool,
    *,
    first_light: str | None = None,
    refuse: bool = True,
) -> FoundLights:
    """Find the lights of the images of one object.

    Args:
        observations: (P, F), linear, 0 or more; divided by the light intensities where they are known.
        mask: (H, W) with P true pixels, in row-major order.
        intensities_known: whether the intensities are known; else they are found, too.
        first_light: where the light of the first observations comes from; see azimuth_of. It decides between a bump and
            a hollow. Without it, shadows and the outline decide.
        refuse: raise an error for lights that the images do not tell; else return a guess.

    Raises:
        UsageError: the first light is no known side, and no azimuth.
        InputError: the images are all alike, they do not show one surface, or they do not tell the lights.
    """
    step = max(1, math.ceil(math.sqrt(len(observations) / _MOST_PIXELS)))
    if step > 1:
        grid = np.zeros_like(mask)
        grid[::step, ::step] = mask[::step, ::step]
        observations, mask = observations[grid[mask]], mask[::step, ::step]
    _check_different(observations)
    outlined = outline_share(mask) >= LEAST_OUTLINE
    if refuse and first_light is None and not outlined:
        raise InputError(
            "the images do not show the outline of the object, so a bump looks like a hollow under opposite lights",
            hint="If the images show the whole object, give its mask, or add --auto-mask. Else say where the light of"
            " the first image that is used comes from: --first-light left, upper-left, or its azimuth in degrees,"
            " counter-clockwise from the right",
        )
    directions, errors_deg, intensities = _ask_network(observations, mask)
    if first_light is not None:
        directions = _towards(directions, first_light)
    if not intensities_known:
        observations = np.asarray(observations / intensities, np.float32)
    error = 0.0 if intensities_known else INTENSITY_ERROR
    fit = fit_near(observations, directions, errors_deg, intensity_error=error, worth_pixels=_WORTH_PIXELS)
    if refuse and fit is not None and fit.after > LARGEST_MISFIT:
        problem = "the images do not show one surface under different distant lights, so the lights cannot be found"
        hint = "Check that camera and object stood still, and that all images show the same object"
        raise InputError(problem, hint=hint)
    if fit is not None and fit.after < fit.before and (fit.directions[:, 2] > 0).all():
        directions, intensities = fit.directions, intensities * fit.intensities
        observations = np.asarray(observations / fit.intensities, np.float32)
    expected_deg, opposite_share = float(errors_deg.mean()), 0.0
    if first_light is None:
        log_odds = bump_log_odds(observations, mask, directions)
        log_odds += max(_FEWEST_LOG_ODDS, _MOST_LOG_ODDS - _LOG_ODDS_PER_DEG * expected_deg)
        directions = directions * (-1, -1, 1) if log_odds < 0 else directions
        opposite_share = 1 / (1 + math.exp(abs(log_odds)))
    turn = turn_at_outline(observations, mask, directions)
    if turn is not None and turn.spread < _CLEAR_OUTLINE:
        share = _OUTLINE_SHARE * min(1, _LARGEST_TURN * expected_deg / max(turn.angle_deg, 1e-9))
        turned = directions @ turn.share(share).T
        directions = turned if (turned[:, 2] > 0).all() else directions
    directions = lower_lights(observations, directions, expected_deg)
    found_deg = _ERROR_SCALE * expected_deg**_ERROR_POWER if outlined else _ERROR_SHARE * expected_deg
    errors_deg = errors_deg * math.hypot(found_deg, _LEAST_ERROR_DEG) / expected_deg
    opposite_deg = 2 * np.degrees(np.arccos(directions[:, 2].clip(-1, 1)))
    errors_deg = (1 - opposite_share) * errors_deg + opposite_share * opposite_deg
    if refuse and (expected := float(errors_deg.mean())) > LARGEST_ERROR_DEG:
        raise InputError(
            f"the lights cannot be told from the images: their expected error is {expected:.0f} degrees, and at most"
            f" {LARGEST_ERROR_DEG:.0f} is of use",
            hint="Show the whole outline of the object and give its mask, add images with other lights, or measure the"
            " lights with 'splinecli calibrate'",
        )
    return FoundLights(directions, errors_deg, None if intensities_known else intensities / intensities.mean())


def _towards(directions: NDArray[np.float64], first_light: str) -> NDArray[np.float64]:
    """Return the directions (F, 3), or those with opposite x and y, whichever has the first light on this side.

    Raises InputError where it is on neither side clearly.
    """
    azimuth = math.radians(azimuth_of(first_light))
    towards = float(directions[0, :2] @ (math.cos(azimuth), math.sin(azimuth)))
    if abs(towards) < LEAST_SIDE:
        problem = f"the first light does not come clearly from {first_light}, nor from the opposite side"
        hint = "Give its azimuth in degrees, as --first-light 45, or put an image with a light from a side first"
        raise InputError(problem, hint=hint)
    return directions * (-1, -1, 1) if towards < 0 else directions


def _check_different(observations: NDArray[np.float32]) -> None:
    """Raise InputError for images that show no change of the light."""
    rows = observations[:: max(1, len(observations) // 10_000)].astype(np.float64)
    rows = rows / np.maximum(rows.mean(axis=0), 1e-12)  # a change of exposure is none of the light
    mean = rows.mean(axis=1, keepdims=True)
    if np.abs(rows - mean).mean() <= SAME_IMAGES * mean.mean():  # equal for black images
        problem = "all images are alike, so they say nothing about the lights"
        raise InputError(problem, hint="Photograph the object with the lamp at a different place for each image")


def _ask_network(
    observations: NDArray[np.float32], mask: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the directions (F, 3), their expected errors (F,) in degrees and the intensities (F,).

    They are means over the four turns of the images by 90 degrees and their mirror images.
    """
    area, image = torch.from_numpy(mask), np.zeros(mask.shape, np.float32)
    small = []
    for values in observations.T:  # one image at a time: all of them would double the memory
        image[mask] = values
        cut, inside = square_images(torch.from_numpy(image)[None], area)
        small.append(cut[0])
    if not inside.any():
        raise InputError(
            "the mask is too thin or too scattered to find the lights", hint="Give a mask of the whole object"
        )
    images = torch.stack(small)
    images = images / images[:, inside > 0].quantile(0.99).clamp(min=1e-9)
    network = light_net()
    # One thread each, so that the number of threads does not change the rounding.
    guesses = [*side_by_side(lambda view: _view(network, images, inside, *view), _VIEWS)]
    directions, sharpness, log_intensities = (torch.cat(part).double() for part in zip(*guesses, strict=True))
    towards = (sharpness.exp()[..., None] * directions).sum(dim=0)
    mean = torch.nn.functional.normalize(towards, dim=-1)
    between = (directions * mean).sum(dim=-1).clamp(-1, 1).acos().square().mean(dim=0)
    own = (math.pi / 2 / sharpness.exp()).mean(dim=0)  # mean square errors of normal distributions
    return mean.numpy(), (own + between).sqrt().rad2deg().numpy(), log_intensities.mean(dim=0).exp().numpy()


def _view(network: LightNet, images: torch.Tensor, inside: torch.Tensor, turns: int, mirrored: bool) -> LightGuess:
    """Return what the network reads off turned, then mirrored images, in the frame of the images as they are."""
    images, inside = torch.rot90(images, turns, (1, 2)), torch.rot90(inside, turns, (0, 1))
    if mirrored:
        images, inside = images.flip(2), inside.flip(1)
    guess: LightGuess = network(network_inputs(images, inside)[None])
    x, y, z = guess.directions.unbind(dim=-1)
    x = -x if mirrored else x
    for _ in range(turns):
        x, y = y, -x
    return guess._replace(directions=torch.stack((x, y, z), dim=-1))
