"""How well images fit light directions, also in other orders of the lights; light_order.py judges these.

The images of a matte object under F distant lights are a matrix of rank 3: observations = scaled normals times lights
(Woodham 1980; Hayakawa, "Photometric stereo under a light source with arbitrary motion", JOSA A 1994). Its three
factors are found without the lights. Right lights are linear combinations of these factors, whatever their frame.
Lights in a wrong order are not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splinecli.fits.robust import absolute_weights, fit_robustly, fit_scaled_normals, lit_values
from splinecli.maths import Doubles, Floats

LIT_SHARE = 0.1  # observations below this share of a pixel's largest one count as shadow

DARK_SHARES = (0.1, 0.02)
"""Pixels below this share of the brightest hundredth are left out: background. The second counts where too few are left
by the first, because highlights outshine the object."""

MIN_PIXELS_PER_LIGHT = 10

MAX_PIXELS, MAX_OBSERVATIONS = 4000, 120_000  # limits of the sample that the factors are found from
RANDOM_ORDERS = 250  # number of random orders of the lights that a given order is compared with
INTENSITY_PRIOR = 0.01  # weight of equal intensities against those that fit best, where nobody measured them

INTENSITY_LIMITS = (0.1, 10.0)

_ROUNDS, _INTENSITY_ROUNDS = 8, 12  # more rounds fit the highlights of metals
_PRIOR = 1e-9
_FITS = 5


@dataclass(frozen=True, eq=False)
class Factors:
    """The best factors of rank 3 of some observations."""

    # (3, F). Its rows are scaled by the share of the brightness that they explain, so that a distance between two such
    # matrices is one between images, as a share of the mean brightness
    matrix: Doubles
    image_residuals: Doubles  # (F,), root mean squares of what the factors do not explain of each image, in this unit
    intensities_known: bool = True  # whether the observations were divided by measured light intensities

    @property
    def residual(self) -> float:
        """What the factors do not explain of all images."""
        return float(np.linalg.norm(self.image_residuals))

    def with_free_intensities(self) -> Factors:
        """Return the factors of the same observations, to be compared with lights of any intensities."""
        return replace(self, intensities_known=False)

    def misfits(self, light_directions: Doubles) -> Doubles:
        """Return the root mean square distances (N,) from the images that lights (N, F, 3) can explain."""
        if self.intensities_known:
            return self.distances(np.linalg.qr(light_directions)[0])
        intensities, matrices = self._fit_intensities(light_directions)
        differences = self.matrix.T - intensities[..., None] * matrices
        return np.asarray(np.sqrt((differences**2).sum(axis=(1, 2))))

    def distances(self, bases: Doubles) -> Doubles:
        """Return the root mean square distances (N,) from the images that orthonormal bases (N, F, 3) can explain."""
        explained = ((self.matrix @ bases) ** 2).sum(axis=(1, 2))
        return np.asarray(np.sqrt(np.maximum((self.matrix**2).sum() - explained, 0)))

    def intensities(self, light_directions: Doubles) -> Doubles:
        """Return the intensities (N, F) that fit lights (N, F, 3) best; ones where they are known."""
        if self.intensities_known:
            return np.ones(light_directions.shape[:2])
        return self._fit_intensities(light_directions)[0]

    def _fit_intensities(self, light_directions: Doubles) -> tuple[Doubles, Doubles]:
        """Return intensities (N, F), and the matrices (N, F, 3) that lights of intensity 1 would give."""
        # Intensities and the 3 x 3 matrix between lights and factors are fitted in turn (Cho et al., TPAMI 2018).
        prior = INTENSITY_PRIOR * (self.matrix**2).sum(axis=0).mean()
        intensities = np.ones(light_directions.shape[:2])
        for _ in range(_INTENSITY_ROUNDS):
            vectors = intensities[..., None] * light_directions
            transposed = vectors.swapaxes(1, 2)
            products = transposed @ vectors + _PRIOR * np.eye(3)  # lights may lie in one plane
            matrices = light_directions @ np.linalg.solve(products, transposed @ self.matrix.T)
            along = np.einsum("cf,nfc->nf", self.matrix, matrices)
            intensities = (along + prior) / ((matrices**2).sum(axis=2) + prior)
            intensities = intensities.clip(*INTENSITY_LIMITS)
        return intensities, matrices


def find_factors(observations: Floats, *, intensities_known: bool = True) -> Factors | None:
    """Return the factors of observations (P, F), or None where there are too few lit ones.

    Shadows do not count, and highlights count little: least absolute deviations, by weighted least squares.
    """
    values = sample_pixels(observations)
    n_pixels, n_lights = values.shape
    if n_lights < 4 or n_pixels < MIN_PIXELS_PER_LIGHT * n_lights:
        return None
    lit = (values > LIT_SHARE).astype(np.float64)
    matrix = np.linalg.svd(values, full_matrices=False)[2][:3]
    weights = lit
    for _ in range(_ROUNDS):
        rows = fit_scaled_normals(values, weights, matrix.T, prior=_PRIOR)
        matrix = fit_scaled_normals(values.T, weights.T, rows, prior=_PRIOR).T
        residuals = values - rows @ matrix
        weights = lit * absolute_weights(residuals)
    # The largest values of a row are 1, but a few rows in deep shadow may be wild.
    kept = np.abs(rows @ matrix).max(axis=1) < 3
    rows, residuals, lit = rows[kept], residuals[kept], lit[kept]
    if len(rows) < MIN_PIXELS_PER_LIGHT * n_lights:
        return None
    brightness = np.sqrt((values[kept] ** 2).sum(axis=1).mean())
    scale = np.linalg.qr(rows)[1] / np.sqrt(len(rows)) / brightness
    residuals = np.sqrt((residuals**2 * lit).mean(axis=0)) / brightness
    return Factors(scale @ matrix, residuals, intensities_known)


def random_misfits(factors: Factors, light_directions: Doubles) -> Doubles:
    """Return the misfits of the lights (F, 3) in random orders, in rising order."""
    given = np.tile(np.arange(len(light_directions)), (RANDOM_ORDERS, 1))
    orders = np.random.default_rng(0).permuted(given, axis=1)
    if factors.intensities_known:
        # One basis serves all orders, which saves most of the time.
        return np.sort(factors.distances(np.linalg.qr(light_directions)[0][orders]))
    return np.sort(factors.misfits(light_directions[orders]))


def shifted_orders(n_lights: int) -> NDArray[np.int64]:
    """Return the orders (2 F, F) of all cyclic shifts, then those of the reversed order's; the first is the given."""
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


def fit_residual(values: Doubles, light_directions: Doubles) -> float:
    """Return the mean |difference| of lit values (p, F) from a fit of least absolute deviations under lights (F, 3).

    It is a share of the mean of the lit values.
    """
    lit = (values > LIT_SHARE).astype(np.float64)
    normals, _ = fit_robustly(values, lit, light_directions, _FITS)
    residuals = values - normals @ light_directions.T
    return float((np.abs(residuals) * lit).sum() / (values * lit).sum())


def sample_pixels(observations: Floats) -> Doubles:
    """Return lit pixels (p, F), each scaled to a largest observation of 1."""
    n_lights = observations.shape[1]
    for share in DARK_SHARES:
        _, values = lit_values(observations, share, min(MAX_PIXELS, max(MAX_OBSERVATIONS // n_lights, 1)))
        # Three unknowns need more than three lit observations to leave a residual.
        kept: Doubles = values[(values > LIT_SHARE).sum(axis=1) >= 4]
        if len(kept) >= MIN_PIXELS_PER_LIGHT * n_lights:
            break
    return kept
