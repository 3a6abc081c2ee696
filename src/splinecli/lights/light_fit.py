"""How well images fit light directions, including other orders of the lights, and refinement of
rough directions.

The images of a matte object under F distant lights form a matrix of rank 3: observations = scaled
normals times lights (Woodham 1980; Hayakawa, "Photometric stereo under a light source with
arbitrary motion", JOSA A 1994). Its three factors are computed without the lights. In any frame,
correct lights are linear combinations of these factors. Lights in the wrong order are not.

Refinement alternates between robust fits of the normals and of the lights. For a matte surface, I =
l . b, so each step is linear. This is semi-calibrated photometric stereo (Cho et al., TPAMI 2018)
in which the directions are also free, with a prior around the given ones. The prior fixes the
remaining freedom, a common rotation of lights and normals. If the light intensities are unknown, a
prior on them fixes the generalised bas-relief ambiguity (Belhumeur, Kriegman and Yuille, IJCV
1999).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.record import Capture
from splinecli.errors import UsageError
from splinecli.maths import Float32Array, Float64Array, Floats
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.robust import absolute_weights, fit_robustly, fit_scaled_normals, lit_values
from splinecli.records.capture_warnings import REFINED_LIGHTS, REFINEMENT_REJECTED, CaptureWarning

LIT_SHARE = 0.1  # observations below this share of a pixel's largest one are treated as shadow
MIN_PIXELS_PER_LIGHT = 10
LIGHT_ERROR_DEG, LARGEST_LIGHT_ERROR_DEG = 5.0, 30.0  # usual and largest error of a rough direction
FEWEST_TO_REFINE = 6  # with fewer lights, normals can compensate for errors of the lights
INTENSITY_ERROR = 0.15  # standard deviation of unmeasured intensities, in the prior
_MIN_PIXELS = 100
_PRIOR = 1e-9


@dataclass(frozen=True, eq=False)
class Factors:
    """The best factors of rank 3 of observations."""

    # (3, F). The rows are scaled by the share of the brightness that they explain, so that the
    # distance between two such matrices is a distance between images, relative to the mean
    # brightness
    matrix: Float64Array
    # (F,), RMS residual of each image after fitting the factors, in the same unit
    image_residuals: Float64Array
    # whether the observations were divided by measured light intensities
    intensities_known: bool = True

    @property
    def residual(self) -> float:
        """The residual of all images after fitting the factors."""
        return float(np.linalg.norm(self.image_residuals))

    def with_free_intensities(self) -> Factors:
        """Return the factors of the same observations, for comparison with lights of any
        intensities.
        """
        return replace(self, intensities_known=False)

    def misfits(self, light_directions: Float64Array) -> Float64Array:
        """Return the RMS distances (N,) from the closest images that lights (N, F, 3) explain."""
        if self.intensities_known:
            return self.distances(np.linalg.qr(light_directions)[0])
        found = []
        # Parts that fit into the processor's cache take half the time.
        for part in np.array_split(light_directions, light_directions.size // 30_000 + 1):
            intensities, matrices = self._fit_intensities(part)
            differences = self.matrix.T - intensities[..., None] * matrices
            found.append(np.sqrt((differences**2).sum(axis=(1, 2))))
        return np.concatenate(found)

    def distances(self, bases: Float64Array) -> Float64Array:
        """Return the RMS distances (N,) from the closest images that orthonormal bases (N, F, 3)
        explain.
        """
        explained = ((self.matrix @ bases) ** 2).sum(axis=(1, 2))
        return np.asarray(np.sqrt(np.maximum((self.matrix**2).sum() - explained, 0)))

    def intensities(self, light_directions: Float64Array) -> Float64Array:
        """Return the intensities (N, F) that fit lights (N, F, 3) best; ones if they are known."""
        if self.intensities_known:
            return np.ones(light_directions.shape[:2])
        return self._fit_intensities(light_directions)[0]

    def _fit_intensities(self, light_directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return intensities (N, F), and the factors (N, F, 3) of lights of intensity 1."""
        # Alternate between the intensities and the 3 x 3 matrix between lights and factors (Cho et
        # al., TPAMI 2018), with a weak prior for equal intensities.
        prior = 0.01 * (self.matrix**2).sum(axis=0).mean()
        intensities = np.ones(light_directions.shape[:2])
        for _ in range(12):
            vectors = intensities[..., None] * light_directions
            transposed = vectors.swapaxes(1, 2)
            products = transposed @ vectors + _PRIOR * np.eye(3)  # lights may be coplanar
            matrices = light_directions @ np.linalg.solve(products, transposed @ self.matrix.T)
            along = np.einsum("cf,nfc->nf", self.matrix, matrices)
            intensities = (along + prior) / ((matrices**2).sum(axis=2) + prior)
            intensities = intensities.clip(0.1, 10.0)
        return intensities, matrices


def find_factors(observations: Floats, *, intensities_known: bool = True) -> Factors | None:
    """Return the factors of observations (P, F); None if too few of them are lit.

    The fit minimises absolute deviations by weighted least squares, so highlights have small
    weights. Shadows are left out.
    """
    values = sample_pixels(observations)
    n_pixels, n_lights = values.shape
    if n_lights < 4 or n_pixels < MIN_PIXELS_PER_LIGHT * n_lights:
        return None
    lit = (values > LIT_SHARE).astype(np.float64)
    matrix = np.linalg.svd(values, full_matrices=False)[2][:3]
    weights = lit
    for _ in range(8):  # further rounds would fit the highlights of metals
        rows = fit_scaled_normals(values, weights, matrix.T, prior=_PRIOR)
        matrix = fit_scaled_normals(values.T, weights.T, rows, prior=_PRIOR).T
        residuals = values - rows @ matrix
        weights = lit * absolute_weights(residuals)
    # The largest value of a row is about 1, except in a few rows in deep shadow.
    kept = np.abs(rows @ matrix).max(axis=1) < 3
    rows, residuals, lit = rows[kept], residuals[kept], lit[kept]
    if len(rows) < MIN_PIXELS_PER_LIGHT * n_lights:
        return None
    brightness = np.sqrt((values[kept] ** 2).sum(axis=1).mean())
    scale = np.linalg.qr(rows)[1] / np.sqrt(len(rows)) / brightness
    residuals = np.sqrt((residuals**2 * lit).mean(axis=0)) / brightness
    return Factors(scale @ matrix, residuals, intensities_known)


def divide_by_fitted(
    observations: Floats, light_directions: Float64Array, factors: Factors | None
) -> Floats:
    """Return observations (P, F), divided by the intensities that fit lights (F, 3) best; without
    factors, or if the intensities are known, as they are.
    """
    if factors is None or factors.intensities_known:
        return observations
    return np.asarray(observations / factors.intensities(light_directions[None])[0])


def random_misfits(factors: Factors, light_directions: Float64Array) -> Float64Array:
    """Return the ascending residuals of the lights (F, 3) in 250 random orders."""
    given = np.tile(np.arange(len(light_directions)), (250, 1))
    orders = np.random.default_rng(0).permuted(given, axis=1)
    if factors.intensities_known:
        # One basis for all orders saves most of the time.
        return np.sort(factors.distances(np.linalg.qr(light_directions)[0][orders]))
    return np.sort(factors.misfits(light_directions[orders]))


def shifted_orders(n_lights: int) -> NDArray[np.int64]:
    """Return the orders (2 F, F): all cyclic shifts of the given order, then those of its reverse.

    The first one is the given order.
    """
    steps = np.arange(n_lights)
    forward = (steps[None] + steps[:, None]) % n_lights
    return np.concatenate((forward, forward[:, ::-1]))


def swapped_orders(n_lights: int) -> NDArray[np.int64]:
    """Return the orders (F (F - 1) / 2, F) with two lights exchanged."""
    first, second = np.triu_indices(n_lights, 1)
    orders = np.tile(np.arange(n_lights), (len(first), 1))
    rows = np.arange(len(first))
    orders[rows, first], orders[rows, second] = second, first
    return orders


def fit_residual(values: Float64Array, light_directions: Float64Array) -> float:
    """Return the mean |residual| of lit values (p, F) after a robust fit under lights (F, 3).

    The fit minimises absolute deviations. The residual is relative to the mean of the lit values.
    """
    lit = (values > LIT_SHARE).astype(np.float64)
    normals, _ = fit_robustly(values, lit, light_directions, 5)
    residuals = values - normals @ light_directions.T
    return float((np.abs(residuals) * lit).sum() / (values * lit).sum())


def sample_pixels(observations: Floats) -> Float64Array:
    """Return lit pixels (p, F), each scaled so that its largest observation is 1."""
    n_lights = observations.shape[1]
    # Pixels below this share of the brightest hundredth are treated as background. If highlights
    # outshine the object, the first share leaves too few pixels.
    for share in (0.1, 0.02):
        _, values = lit_values(observations, share, min(4000, max(120_000 // n_lights, 1)))
        # With three unknowns, only pixels with more than three lit observations have a residual.
        kept: Float64Array = values[(values > LIT_SHARE).sum(axis=1) >= 4]
        if len(kept) >= MIN_PIXELS_PER_LIGHT * n_lights:
            break
    return kept


class LightFit(NamedTuple):
    """Lights near the given ones that fit the images best."""

    directions: Float64Array  # (F, 3), unit
    # (F,), relative to the intensities by which the observations were divided
    intensities: Float64Array
    # the median residuals before and after the fit, relative to a pixel's brightest observation
    before: float
    after: float

    @property
    def fit_ratio(self) -> float:
        """The median residual after the fit divided by the one before."""
        return self.after / max(self.before, 1e-12)


def refine_capture(
    capture: Capture, *, error_deg: float | None = None, intensities_known: bool = True
) -> Capture:
    """Return the capture with refined lights, or unchanged if they do not fit much better.

    A warning reports the result. `error_deg` is the usual error of the given directions, by default
    LIGHT_ERROR_DEG. Raises UsageError if the capture has near lamps, or if the error is not between
    0 and LARGEST_LIGHT_ERROR_DEG.
    """
    check_distant("--refine-lights", "refines", near=capture.lamps is not None)
    error_deg = LIGHT_ERROR_DEG if error_deg is None else error_deg
    check_light_error(error_deg, refines=True)
    found = refine_lights(
        capture.observations,
        capture.light_directions,
        error_deg=error_deg,
        intensities_known=intensities_known,
    )
    if found is None:
        reason = "no nearby directions fit the images much better"
        if capture.n_lights < FEWEST_TO_REFINE:
            reason = f"there are fewer than {FEWEST_TO_REFINE} lights"
        elif _choose_pixels(capture.observations) is None:
            reason = f"there are fewer than {_MIN_PIXELS} lit pixels"
        kept = CaptureWarning(
            REFINEMENT_REJECTED, f"The light directions were not refined, because {reason}."
        )
        return replace(capture, warnings=(*capture.warnings, kept))
    intensities = capture.estimated_intensities
    if not intensities_known:
        intensities = found.intensities if intensities is None else intensities * found.intensities
    moved_deg = angle_between_deg(found.directions, capture.light_directions)
    text = (
        f"The light directions were refined by {moved_deg.mean():.1f} degrees on average, at most"
        f" {moved_deg.max():.1f}, which reduces the residual to {100 * found.fit_ratio:.0f} %."
    )
    return replace(
        capture,
        observations=np.asarray(capture.observations / found.intensities, np.float32),
        light_directions=found.directions,
        estimated_intensities=intensities,
        warnings=(*capture.warnings, CaptureWarning(REFINED_LIGHTS, text)),
    )


def would_refine(
    observations: Floats, factors: Factors | None, light_directions: Float64Array
) -> LightFit | None:
    """Return refined lights if they fit observations (P, F) much better than the given ones; else
    None.

    This is fast if the given lights (F, 3) fit well. For the factors of the observations, see
    find_factors.
    """
    # Few matte or shiny captures with exact lights have a residual above this share of the
    # brightness. Below it, trying a refinement only to suggest it is not worth the time.
    if factors is None or factors.misfits(light_directions[None])[0] < 0.04:
        return None
    # Residuals due to unmeasured intensities must not be attributed to the directions.
    intensities = factors.intensities(light_directions[None])[0]
    return refine_lights(np.asarray(observations / intensities, np.float32), light_directions)


def check_distant(option: str, verb: str, *, near: bool) -> None:
    """Raise UsageError if an option that refines or finds distant lights is used with near
    lamps.
    """
    if near:
        raise UsageError(
            f"{option} {verb} distant lights, but this capture has near lamps",
            hint=f"Leave {option} out",
        )


def check_light_error(error_deg: float | None, *, refines: bool) -> None:
    """Raise UsageError if the usual error of the directions is out of range, or given without
    refinement.
    """
    if error_deg is None:
        return
    if not refines:
        raise UsageError(
            "--light-error-deg needs --refine-lights", hint="Add --refine-lights, or leave both out"
        )
    if not 0 < error_deg <= LARGEST_LIGHT_ERROR_DEG:
        raise UsageError(
            f"the light error is {error_deg:g} degrees, expected above 0 and at most"
            f" {LARGEST_LIGHT_ERROR_DEG:g}"
        )


def refine_lights(
    observations: Float32Array,
    light_directions: Float64Array,
    *,
    error_deg: float = LIGHT_ERROR_DEG,
    intensities_known: bool = True,
) -> LightFit | None:
    """Return refined lights; None if the images do not determine them or hardly improve the fit.

    The observations (P, F) are linear, divided by the light intensities; the directions (F, 3) are
    unit. For the other arguments, see refine_capture.
    """
    intensity_error = 0.0 if intensities_known else INTENSITY_ERROR
    fit = fit_near(
        observations,
        light_directions,
        error_deg,
        intensity_error=intensity_error,
        worth_pixels=50.0,
    )
    if fit is None:
        return None
    # Refined lights are used if they reduce the median residual to 70 %, which seldom happens on
    # rendered captures with exact lights (docs/measurements.md). The absolute limit excludes
    # metals, for which a matte model would refine the lights wrongly.
    better = fit.after < 0.018 and fit.fit_ratio < 0.7 and bool((fit.directions[:, 2] > 0).all())
    return fit if better else None


def fit_near(
    observations: Float32Array,
    light_directions: Float64Array,
    error_deg: float | Float64Array,
    *,
    intensity_error: float,
    worth_pixels: float,
) -> LightFit | None:
    """Return the lights near the given ones that fit the images best; None for too few lights or
    pixels.

    The observations (P, F) are linear, and the directions (F, 3) are unit. `error_deg` is the usual
    error of each direction (F,), or of all of them; `intensity_error` is relative, 0 for known
    intensities. `worth_pixels` is the number of independent pixels that the images are worth
    relative to the prior. It is small because the errors of a matte model are similar in many
    pixels.
    """
    values = _choose_pixels(observations)
    if values is None:
        return None
    reference = 0.1 * np.quantile(values, 0.6, axis=1, keepdims=True)  # as in IW12
    lit = (values > reference).astype(np.float64)
    lights = light_directions
    normals, weights = fit_robustly(values, lit, lights, 8)
    before = _residual(values, normals, lights, lit)
    # The precision (F, 3, 3) of the given light vectors, along and across them. Both components of
    # the angle have half of its variance.
    along = lights[:, :, None] * lights[:, None, :]
    across_variance = np.broadcast_to(np.radians(error_deg) ** 2 / 2, len(along))[:, None, None]
    precision = (np.eye(3) - along) / across_variance + along / (
        intensity_error or INTENSITY_ERROR
    ) ** 2
    for _ in range(150):
        normals, weights = fit_robustly(values, lit, lights, 2, weights)
        residuals = values - normals @ lights.T
        variance = (weights * residuals**2).sum() / weights.sum()
        # A light that reaches no pixel keeps its vector.
        scale = worth_pixels / (weights.sum(axis=0).clip(min=1) * max(variance, 1e-12))
        curvature = (
            np.einsum("pf,pi,pj->fij", weights, normals, normals, optimize=True)
            * scale[:, None, None]
        )
        gradient = ((weights * residuals).T @ normals) * scale[:, None]
        pull = np.einsum("fij,fj->fi", precision, light_directions - lights)
        step = np.linalg.solve(curvature + precision, (gradient + pull)[..., None])[..., 0]
        moved = lights + step if intensity_error else unit(lights + step)
        change, lights = np.abs(moved - lights).max(), moved
        if change < 1e-4:
            break
    normals, _ = fit_robustly(values, lit, lights, 8, weights)
    after = _residual(values, normals, lights, lit)
    return LightFit(unit(lights), np.linalg.norm(lights, axis=1), before, after)


def _choose_pixels(observations: Float32Array) -> Float64Array | None:
    """Return observations (p, F) of lit pixels, each scaled to a maximum of 1; None for too few."""
    if observations.shape[1] < FEWEST_TO_REFINE:
        return None
    _, values = lit_values(observations, 0.02, 2000)
    return values.clip(min=0) if len(values) >= _MIN_PIXELS else None


def _residual(
    values: Float64Array, normals: Float64Array, lights: Float64Array, lit: Float64Array
) -> float:
    return float(np.median(np.abs(values - normals @ lights.T)[lit > 0]))
