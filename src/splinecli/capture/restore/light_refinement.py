"""Rough light directions, refined from the images of the object.

Normals and lights are fitted in turn, robustly: with I = l . b for a matte surface, each step is linear. This is
semi-calibrated photometric stereo (Cho et al., TPAMI 2018) with directions that are free, too, within a prior around
the given ones. The prior holds what the images leave open: lights and normals may turn together. If the light
intensities are known, nothing else is open. If not, a prior on them holds the generalised bas-relief ambiguity
(Belhumeur, Kriegman and Yuille, IJCV 1999).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from splinecli.capture.lights.light_fit import Factors
from splinecli.capture.record import Capture
from splinecli.capture_warnings import KEPT_LIGHTS, REFINED_LIGHTS, CaptureWarning
from splinecli.errors import UsageError
from splinecli.fits.robust import fit_robustly, lit_values
from splinecli.maths import Doubles, Floats, Singles
from splinecli.maths.normals import angle_between_deg, unit

LIGHT_ERROR_DEG = 5.0  # usual error of a rough direction

LARGEST_LIGHT_ERROR_DEG = 30.0

MIN_LIGHTS = 6  # with fewer lights, an error of a light looks like one of the normals

BETTER_FIT = 0.7
"""Refined lights are taken if the median residual falls below this share of that under the given lights. On rendered
captures with exact lights, it seldom does; docs/measurements.md has the figures."""

MAX_MISFIT = 0.018
"""Largest median residual, as a share of a pixel's brightest observation, with which refined lights are taken. Metals
have more, and a matte model would move their lights wrongly."""

ROUGH_MISFIT = 0.04
"""Smallest misfit of rough directions, as a share of the brightness. Below it, refinement is not tried only to be
suggested. Few matte or shiny captures with exact lights have more."""

INTENSITY_ERROR = 0.15  # standard deviation of intensities that nobody measured, in the prior

_MAX_PIXELS = 2000
_MIN_PIXELS = 100
_DARK_SHARE = 0.02
_SHADOW_SHARE = 0.1  # of the pixel's quantile below, as in IW12
_UNSHADED = 0.6
_WORTH_PIXELS = 50.0  # see fit_near

_MAX_ROUNDS = 150
_FIRST_FITS, _FITS_PER_ROUND = 8, 2
_CONVERGED = 1e-4


class LightFit(NamedTuple):
    """Lights that fit the images best near given ones."""

    directions: Doubles  # (F, 3), unit
    intensities: Doubles  # (F,), relative to those of the observations
    # before, after: the median residuals under the given lights and under these, as shares of a pixel's brightest
    # observation
    before: float
    after: float

    @property
    def fit_ratio(self) -> float:
        """The median residual, as a share of that under the given lights."""
        return self.after / max(self.before, 1e-12)


def refine_capture(capture: Capture, *, error_deg: float | None = None, intensities_known: bool = True) -> Capture:
    """Return the capture with refined lights, or as it is where they do not fit much better. A warning says which.

    Args:
        error_deg: the usual error of the given directions; None for LIGHT_ERROR_DEG.
        intensities_known: whether the light intensities were measured.

    Raises:
        UsageError: the capture has near lamps, or the error is not from 0 to LARGEST_LIGHT_ERROR_DEG.
    """
    check_distant("--refine-lights", "refines", near=capture.lamps is not None)
    error_deg = LIGHT_ERROR_DEG if error_deg is None else error_deg
    check_light_error(error_deg, refines=True)
    found = refine_lights(
        capture.observations, capture.light_directions, error_deg=error_deg, intensities_known=intensities_known
    )
    if found is None:
        kept = CaptureWarning(KEPT_LIGHTS, f"The light directions were not refined: {_why_kept(capture)}.")
        return replace(capture, warnings=(*capture.warnings, kept))
    intensities = capture.estimated_intensities
    if not intensities_known:
        intensities = found.intensities if intensities is None else intensities * found.intensities
    moved_deg = angle_between_deg(found.directions, capture.light_directions)
    text = (
        f"The light directions were refined: moved by {moved_deg.mean():.1f} degrees on average, at most"
        f" {moved_deg.max():.1f}. The images fit them better: {100 * found.fit_ratio:.0f} % of the misfit is left."
    )
    return replace(
        capture,
        observations=np.asarray(capture.observations / found.intensities, np.float32),
        light_directions=found.directions,
        estimated_intensities=intensities,
        warnings=(*capture.warnings, CaptureWarning(REFINED_LIGHTS, text)),
    )


def would_refine(observations: Floats, factors: Factors | None, light_directions: Doubles) -> LightFit | None:
    """Return the lights that refinement would give if they fit observations (P, F) much better, or None.

    It is cheap where the given lights (F, 3) fit well. See find_factors for the factors of the observations.
    """
    if factors is None or factors.misfits(light_directions[None])[0] < ROUGH_MISFIT:
        return None
    # Intensities that nobody measured are not the fault of the directions.
    intensities = factors.intensities(light_directions[None])[0]
    return refine_lights(np.asarray(observations / intensities, np.float32), light_directions)


def _why_kept(capture: Capture) -> str:
    if capture.n_lights < MIN_LIGHTS:
        return f"there are fewer than {MIN_LIGHTS} lights"
    if _choose_pixels(capture.observations) is None:
        return f"there are fewer than {_MIN_PIXELS} lit pixels"
    return "no others near them fit the images much better"


def check_distant(option: str, verb: str, *, near: bool) -> None:
    """Raise UsageError for a capture with near lamps under an option that refines or finds distant lights."""
    if near:
        raise UsageError(f"{option} {verb} distant lights, and this capture has near lamps", hint=f"Leave {option} out")


def check_light_error(error_deg: float | None, *, refines: bool) -> None:
    """Raise UsageError for a usual error of directions that is out of range, or given where none are refined."""
    if error_deg is None:
        return
    if not refines:
        raise UsageError("--light-error-deg needs --refine-lights", hint="Add it, or leave both out")
    if not 0 < error_deg <= LARGEST_LIGHT_ERROR_DEG:
        raise UsageError(
            f"the light error is {error_deg:g} degrees, expected above 0 and at most {LARGEST_LIGHT_ERROR_DEG:g}"
        )


def refine_lights(
    observations: Singles,
    light_directions: Doubles,
    *,
    error_deg: float = LIGHT_ERROR_DEG,
    intensities_known: bool = True,
) -> LightFit | None:
    """Return refined lights; None where the images do not tell, or the given lights fit about as well.

    Args:
        observations: (P, F), linear, divided by the light intensities.
        light_directions: (F, 3), unit.
        error_deg, intensities_known: see refine_capture.
    """
    intensity_error = 0.0 if intensities_known else INTENSITY_ERROR
    fit = fit_near(
        observations, light_directions, error_deg, intensity_error=intensity_error, worth_pixels=_WORTH_PIXELS
    )
    if fit is None:
        return None
    better = fit.after < MAX_MISFIT and fit.fit_ratio < BETTER_FIT and bool((fit.directions[:, 2] > 0).all())
    return fit if better else None


def fit_near(
    observations: Singles,
    light_directions: Doubles,
    error_deg: float | Doubles,
    *,
    intensity_error: float,
    worth_pixels: float,
) -> LightFit | None:
    """Return the lights near the given ones that fit the images best; None for too few lights or lit pixels.

    Args:
        observations: (P, F), linear.
        light_directions: (F, 3), unit.
        error_deg: the usual error of each direction (F,), or of all.
        intensity_error: the usual error of intensities of 1, a share; 0 if they are known.
        worth_pixels: the number of pixels that the images weigh against the prior. Errors of a matte model are alike in
            many pixels.
    """
    values = _choose_pixels(observations)
    if values is None:
        return None
    reference = _SHADOW_SHARE * np.quantile(values, _UNSHADED, axis=1, keepdims=True)
    lit = (values > reference).astype(np.float64)
    lights = light_directions
    normals, weights = fit_robustly(values, lit, lights, _FIRST_FITS)
    before = _misfit(values, normals, lights, lit)
    precision = _prior(light_directions, error_deg, intensity_error or INTENSITY_ERROR)
    for _ in range(_MAX_ROUNDS):
        normals, weights = fit_robustly(values, lit, lights, _FITS_PER_ROUND, weights)
        moved = _move_lights(values, normals, weights, lights, light_directions, precision, worth_pixels)
        moved = moved if intensity_error else unit(moved)
        change, lights = np.abs(moved - lights).max(), moved
        if change < _CONVERGED:
            break
    normals, _ = fit_robustly(values, lit, lights, _FIRST_FITS, weights)
    after = _misfit(values, normals, lights, lit)
    return LightFit(unit(lights), np.linalg.norm(lights, axis=1), before, after)


def _choose_pixels(observations: Singles) -> Doubles | None:
    """Return observations (p, F) of lit pixels, each scaled to a largest value of 1; None for too few."""
    if observations.shape[1] < MIN_LIGHTS:
        return None
    _, values = lit_values(observations, _DARK_SHARE, _MAX_PIXELS)
    return values.clip(min=0) if len(values) >= _MIN_PIXELS else None


def _misfit(values: Doubles, normals: Doubles, lights: Doubles, lit: Doubles) -> float:
    return float(np.median(np.abs(values - normals @ lights.T)[lit > 0]))


def _prior(light_directions: Doubles, error_deg: float | Doubles, intensity_error: float) -> Doubles:
    """Return the precision (F, 3, 3) of the given light vectors: of their directions and their lengths."""
    along = light_directions[:, :, None] * light_directions[:, None, :]
    # The angle has two components, each with half of its variance.
    across_variance = np.broadcast_to(np.radians(error_deg) ** 2 / 2, len(along))[:, None, None]
    return np.asarray((np.eye(3) - along) / across_variance + along / intensity_error**2)


def _move_lights(
    values: Doubles,
    normals: Doubles,
    weights: Doubles,
    lights: Doubles,
    given: Doubles,
    precision: Doubles,
    worth_pixels: float,
) -> Doubles:
    """Return the light vectors (F, 3) that fit the observations best, within the prior."""
    residuals = values - normals @ lights.T
    variance = (weights * residuals**2).sum() / weights.sum()
    # A light that no pixel shows keeps its given vector.
    scale = worth_pixels / (weights.sum(axis=0).clip(min=1) * max(variance, 1e-12))
    curvature = np.einsum("pf,pi,pj->fij", weights, normals, normals, optimize=True) * scale[:, None, None]
    gradient = ((weights * residuals).T @ normals) * scale[:, None]
    pull = np.einsum("fij,fj->fi", precision, given - lights)
    step = np.linalg.solve(curvature + precision, (gradient + pull)[..., None])[..., 0]
    return np.asarray(lights + step)
