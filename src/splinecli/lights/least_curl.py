"""The curl of normals, and lights for which a matte surface has normals with the least curl.

The normals of a surface have no curl (Horn, "Shape from shading", 1970). If lights and normals are
multiplied by a matrix and its inverse, a matte surface has the same images, but its normals have
curl unless the matrix is a generalised bas-relief transformation (Belhumeur, Kriegman and Yuille,
"The bas-relief ambiguity", IJCV 1999). If the light intensities are equal or known, only a rotation
remains (Hayakawa, JOSA A 1994), so that two solutions are left, whose x and y have opposite signs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from splinecli.lights.outline import DARK_SHARE
from splinecli.maths import Bools, Float64Array, Floats
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.pixel_grid import Blocks, on_map
from splinecli.maths.robust import SHADOW_SHARE, fit_scaled_normals

OPPOSITE = np.array((-1.0, -1.0, 1.0))
"""Factors of the lights under which a hollow looks like a bump under the original lights."""


def normal_derivatives(normals: Floats, mask: Bools, *, most: int) -> Float64Array | None:
    """Return normals and their derivatives to the right and upwards (3, p, 3).

    At most `most` pixels are returned, all with neighbours, or None if there are fewer than 50. The
    normals (H, W, 3) in a mask (H, W) may have any length.
    """
    from scipy.ndimage import binary_erosion, gaussian_filter

    inside = binary_erosion(mask)
    if np.count_nonzero(inside) < 50 or min(mask.shape) < 2:
        return None
    share = np.maximum(gaussian_filter(mask.astype(np.float64), 1.0), 1e-6)
    smooth = gaussian_filter(
        np.where(mask[..., None], normals, 0.0), (1.0, 1.0, 0), output=np.float64
    )
    smooth /= share[..., None]
    downwards, right = np.gradient(smooth, axis=(0, 1))
    every = -(-np.count_nonzero(inside) // most)
    return np.stack([each[inside][::every] for each in (smooth, right, -downwards)])


def curl_terms(
    vectors: Float64Array, matrices: Floats, *, least_z: float, least_share: float
) -> Float64Array:
    """Return terms (n, p) whose sums over pixels are the curls of normals multiplied by matrices
    (n, 3, 3).

    A curl is the mean |curl| of the slopes divided by their mean derivative. `vectors` (3, p, 3)
    are from normal_derivatives. Normals with z below `least_z` are ignored; if fewer than
    `least_share` of the normals remain, the curl is infinite.
    """
    normals, right, up = np.einsum("dpi,kji->dkpj", vectors, matrices, optimize=True)
    length = np.linalg.norm(normals, axis=2).clip(min=1e-12)
    facing = normals[..., 2] / length
    counts, facing = facing > least_z, facing.clip(min=least_z)
    z = facing * length

    def slope(derivative: Float64Array, axis: int) -> Float64Array:
        change = normals[..., axis] * derivative[..., 2] - derivative[..., axis] * z
        return np.asarray(change / z**2)

    p_x, p_y, q_x, q_y = slope(right, 0), slope(up, 0), slope(right, 1), slope(up, 1)
    curl, size = np.abs(p_y - q_x), np.sqrt(p_x**2 + p_y**2 + q_x**2 + q_y**2)
    # Both are huge at the edges of the object.
    largest = np.quantile(size, 0.95, axis=1, keepdims=True)
    weights = counts * facing**3
    found = weights * np.minimum(curl, largest)
    found /= np.maximum((weights * np.minimum(size, largest)).sum(axis=1, keepdims=True), 1e-12)
    # Otherwise, a matrix could reduce the curl by rotating normals away from the camera.
    return np.where(counts.mean(axis=1, keepdims=True) >= least_share, found, np.inf)


class Lights(NamedTuple):
    """Unit directions (F, 3) and relative intensities (F,) of lights."""

    directions: Float64Array
    intensities: Float64Array


class BestLights(NamedTuple):
    """The lights chosen by a search, and the evidence for them."""

    lights: Lights
    start: int  # the index of the starting point that led to them
    expected: float  # the mean logarithm of the errors in radians predicted by the network
    curl: float  # the curl of the network's normals


_GRID_PIXELS = 3000
_FITS = 60
_LEAST_Z, _LEAST_SHARE = 0.15, 0.6
_CURL_FLOOR = 0.02  # differences between smaller curls are noise
_ROTATIONS, _KEPT = 3000, 80
# weights of the guessed directions and of the logarithm of the curl
_GUESS, _CURL = 4.0, 8.0
# rounds, matrices in each round, and first standard deviation of the search for a matrix
_ROUNDS, _TRIED, _REACH = 16, 100, 0.15
_INTENSITY_SPREAD = 0.15  # standard deviation of the logarithm of unknown intensities


def lights_of_least_curl(
    observations: Floats,
    mask: Bools,
    guess: Lights,
    errors_deg: Float64Array,
    *,
    intensities_known: bool,
) -> list[Lights]:
    """Return lights that explain the images of a matte surface with normals of little curl, the
    best first.

    Each is the result of a search from a different start, so some may be equal. The list is empty
    if too few pixels are lit. The observations (P, F) are linear, divided by known intensities. The
    mask (H, W) has P true pixels, in row-major order. The guess has a low weight; `errors_deg` (F,)
    are its expected errors.
    """
    images = _Images.of(observations / guess.intensities, mask)
    if images is None:
        return []
    rng = np.random.default_rng(0)
    factors = images.factors
    root = _root_of_metric(factors)
    # the smallest standard deviation assumed for known intensities
    spread = max(0.02, 1.5 * images.unit_residual) if intensities_known else _INTENSITY_SPREAD
    guess_deg = np.asarray(errors_deg)

    from scipy.spatial.transform import Rotation

    def costs(matrices: Float64Array) -> Float64Array:
        lights = factors @ matrices
        lengths = np.linalg.norm(lights, axis=2).clip(min=1e-9)
        directions = lights / lengths[..., None]
        residuals = lengths - 1
        if not intensities_known:
            residuals = np.log(lengths) - np.log(lengths).mean(axis=1, keepdims=True)
        cost = 0.5 * np.minimum((residuals / spread) ** 2, 50).sum(axis=1)
        away = np.degrees(np.arccos((directions * guess.directions).sum(axis=2).clip(-1, 1)))
        cost += _GUESS * np.log1p((away / guess_deg) ** 2 / 2).mean(axis=1)
        cost += _CURL * np.log(images.curls(np.linalg.inv(matrices)) + _CURL_FLOOR)
        cost += 1e4 * (np.minimum(directions[..., 2] - 0.05, 0) ** 2).sum(axis=1)
        return np.where(np.isfinite(cost), cost, 1e9)

    rotations = Rotation.random(_ROTATIONS // 2, rng=rng).as_matrix()
    rotations = np.concatenate((rotations, rotations * (1, 1, -1)))
    curls = images.curls(rotations @ np.linalg.inv(root), part=2)
    turned = root @ rotations[np.argsort(curls)[:_KEPT]].transpose(0, 2, 1)
    turned = np.concatenate((turned, turned * OPPOSITE))
    left, _, right = np.linalg.svd((factors @ root).T @ guess.directions)
    starts = np.concatenate(
        (
            np.linalg.lstsq(factors, guess.directions, rcond=None)[0][None],
            turned[np.argsort(costs(turned))[:2]],
            (root @ left @ right)[None],
        )
    )
    starts /= np.linalg.norm(factors @ starts, axis=2).mean(axis=1)[:, None, None]
    found = sorted((_search(start, costs, rng) for start in starts), key=lambda each: each[1])
    lights = [factors @ matrix for matrix, _ in found]
    lengths = [np.linalg.norm(each, axis=1) for each in lights]
    ones = np.ones(len(factors))
    return [
        Lights(unit(each), ones if intensities_known else guess.intensities * own / own.mean())
        for each, own in zip(lights, lengths, strict=True)
    ]


def differ_by_deg(lights: Float64Array, others: Float64Array) -> float:
    """Return the mean angle in degrees between lights (F, 3), without distinguishing bump from
    hollow.
    """
    return float(min(angle_between_deg(lights * sign, others).mean() for sign in (1.0, OPPOSITE)))


@dataclass(frozen=True, eq=False)
class _Images:
    """The images of a matte surface, as factors of rank 3 and corresponding normals."""

    factors: Float64Array  # (F, 3), orthonormal; the lights are the factors times a matrix
    vectors: Float64Array  # (3, p, 3); the normals are these times its inverse

    @classmethod
    def of(cls, observations: Floats, mask: Bools) -> _Images | None:
        blocks = Blocks.over(mask, _GRID_PIXELS)
        values = blocks.average(observations, mask).astype(np.float64)
        brightest = values.max(axis=1)
        bright = brightest > DARK_SHARE * np.quantile(brightest, 0.99)
        if np.count_nonzero(bright) < 50:
            return None
        values = values[bright] / brightest[bright][:, None]
        factors, rows, weights = _factorise(values)
        inside = np.zeros(blocks.mask.shape, np.bool_)
        known = bright.copy()
        known[bright] = np.count_nonzero(weights > 0.3, axis=1) >= 4
        inside[blocks.mask] = known
        vectors = normal_derivatives(on_map(rows[known[bright]], inside), inside, most=700)
        return None if vectors is None else cls(factors, vectors)

    def curls(self, matrices: Floats, part: int = 1) -> Float64Array:
        """Return the curls (n,) of the normals after multiplication by matrices (n, 3, 3)."""
        terms = curl_terms(
            self.vectors[:, ::part], matrices, least_z=_LEAST_Z, least_share=_LEAST_SHARE
        )
        return np.asarray(terms.sum(axis=1))

    @property
    def unit_residual(self) -> float:
        """The deviation of the lengths of the lights from 1 after the metric is fitted."""
        lengths = np.linalg.norm(self.factors @ _root_of_metric(self.factors), axis=1)
        return float(np.abs(lengths**2 - 1).mean())


def _factorise(values: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return factors (F, 3) and rows (p, 3) whose product approximates values (p, F), and weights
    (p, F).

    Shadows and highlights have low weights.
    """
    lit = (values > SHADOW_SHARE).astype(np.float64)
    factors, weights = np.linalg.svd(values, full_matrices=False)[2][:3].T, lit
    for _ in range(_FITS):
        rows = fit_scaled_normals(values, weights, factors, prior=1e-9)
        factors = fit_scaled_normals(values.T, weights.T, rows, prior=1e-9)
        residuals = values - rows @ factors.T
        scale = max(1.5 * float(np.median(np.abs(residuals[lit > 0]))), 0.003)
        weights = lit / (1 + (residuals / (2 * scale)) ** 2)  # Cauchy's
        factors = np.asarray(np.linalg.qr(factors)[0], np.float64)
    rows = fit_scaled_normals(values, weights, factors, prior=1e-9)
    return factors, np.asarray(rows, np.float64), weights


def _root_of_metric(factors: Float64Array) -> Float64Array:
    """Return the symmetric matrix (3, 3) that brings the factors (F, 3) closest to unit vectors."""
    x, y, z = factors.T
    terms = np.stack((x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z), axis=1)
    weights = np.ones(len(factors))
    for _ in range(10):
        metric = np.linalg.lstsq(terms * weights[:, None], weights, rcond=None)[0]
        weights = 1 / np.sqrt(1 + ((terms @ metric - 1) / 0.05) ** 2)
    values, axes = np.linalg.eigh(metric[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]])
    # For metals and noisy images, the metric may have no root.
    values = np.maximum(values, 0.05 * max(np.abs(values).max(), 1e-9))
    return np.asarray((axes * np.sqrt(values)) @ axes.T)


def _search(
    start: Float64Array,
    costs: Callable[[Float64Array], Float64Array],
    rng: np.random.Generator,
) -> tuple[Float64Array, float]:
    """Return the matrix (3, 3) of least cost near a start, and its cost, by CMA-ES.

    See Hansen and Ostermeier (2001).
    """
    best, least = start, float(costs(start[None])[0])
    covariance, middle = _REACH**2 * np.eye(9), np.zeros(9)
    chosen = _TRIED // 4
    shares = np.log(chosen + 0.5) - np.log(np.arange(1, chosen + 1))
    shares /= shares.sum()
    for _ in range(_ROUNDS):
        steps = rng.multivariate_normal(np.zeros(9), covariance, _TRIED, method="cholesky")
        tried = start @ (np.eye(3) + (middle + steps).reshape(-1, 3, 3))
        found = costs(tried)
        order = np.argsort(found)[:chosen]
        if found[order[0]] < least:
            best, least = tried[order[0]], float(found[order[0]])
        own = (steps[order] * shares[:, None]).T @ steps[order]
        covariance = 0.3 * covariance + 0.7 * own + 1e-9 * np.eye(9)
        middle = middle + shares @ steps[order]
    return best, least
