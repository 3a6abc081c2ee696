"""Weighted least squares in torch, pixel by pixel, and the methods based on it.

Robust Lambertian fit, the starting point of the networks: iteratively reweighted least squares of I
= l . b with two weights. Observations below 5 % of the pixel's largest are treated as shadows and
get a tiny weight. Large residuals get smaller weights, which approximates an L1 fit.

Two halves of the lights: random errors differ from light to light, so they make the fits of the two
halves differ. Errors common to all lights do not, but they are similar for all pixels of a
neighbourhood.

L1 minimises the sum of absolute residuals, which is less sensitive to shadows and highlights than
the sum of squares. Trimmed LS discards shadows, and the darkest and brightest observations.

IW12, robust photometric stereo by sparse Bayesian learning: S. Ikehata, D. Wipf, Y. Matsushita, K.
Aizawa, "Robust photometric stereo using sparse regression", CVPR 2012, section 3.2, with lambda =
0, as in the authors' own comparisons.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from splinecli.maths.observation_map import dot
from splinecli.maths.robust import SHADOW_SHARE, SMALLEST_PIVOT, inverse_3x3, multiply_symmetric

# The quantile of a pixel's observations that serves as the reference for its shadows. It allows for
# more than half of the observations being shadows, and more than a third highlights. The largest
# observation would be a poor reference, because on a metal, all others are dark compared with the
# highlight.
UNSHADED = 0.6


def lit_observations(
    observations: Tensor, share: float, valid: Tensor | None = None, *, fewest: int = 3
) -> Tensor:
    """Return which non-negative observations (P, F) are lit: at least `share` of the pixel's
    quantile UNSHADED.

    The `fewest` largest ones are always lit, because a normal needs three. Observations that are
    not valid (P, F) are never lit.
    """
    if not len(observations):  # an empty batch has no quantile
        return observations.bool()
    known = observations if valid is None else observations.masked_fill(~valid, torch.nan)
    floor = share * known.nanquantile(UNSHADED, dim=1, keepdim=True)
    there = observations if valid is None else observations.masked_fill(~valid, 0)
    largest = there.topk(min(fewest, there.shape[1]), dim=1).values[:, -1:]
    lit = observations >= torch.minimum(floor, largest)
    return lit if valid is None else lit & valid


RIDGE = 1e-12  # Weight of |b|^2, which matters only if the lights of positive weight are coplanar.


def weighted_least_squares(
    observations: Tensor, light_directions: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Return b = C L' W I (P, 3), and the entries xx, yy, zz, xy, xz, yz (6, P) of C = (L' W L +
    ridge)^-1.

    Observations and weights are (P, F), and light directions (F, 3) or (P, F, 3). All are float64,
    because weights may differ by many orders of magnitude.
    """
    solution, covariance = _solve(
        observations.T, light_directions, weight.T, direction_products(light_directions)
    )
    return solution.T, covariance


def direction_products(light_directions: Tensor) -> Tensor:
    """Return xx, yy, zz, xy, xz, yz of light directions (F, 3) or (P, F, 3), along the last
    axis.
    """
    x, y, z = light_directions.unbind(-1)
    return torch.stack((x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)


# In the next three functions, rows are lights and columns are pixels, because sums over lights and
# operations on 3 x 3 matrices are three times as fast if they run along the pixels.


def _solve(
    observed: Tensor, light_directions: Tensor, weight: Tensor, products: Tensor
) -> tuple[Tensor, Tensor]:
    """Return b (3, P) and the entries (6, P) of C as in weighted_least_squares, from observations
    and weights (F, P).
    """
    xx, yy, zz, *mixed = _sum(products, weight).unbind()
    covariance = inverse_3x3((xx + RIDGE, yy + RIDGE, zz + RIDGE, *mixed), RIDGE)
    right_side = _sum(light_directions, weight * observed)
    return torch.stack(multiply_symmetric(covariance, right_side.unbind())), torch.stack(covariance)


def _sum(directions: Tensor, weight: Tensor) -> Tensor:
    """Return the sums (K, P) of directions (F, K) or (P, F, K) with weights (F, P)."""
    return directions.T @ weight if directions.ndim == 2 else weighted_sum(weight.T, directions).T


def _dot(directions: Tensor, vectors: Tensor) -> Tensor:
    """Return the dot products (F, P) of directions (F, K) or (P, F, K) with vectors (K, P)."""
    return directions @ vectors if directions.ndim == 2 else dot(vectors.T, directions).T


def weighted_sum(weight: Tensor, directions: Tensor) -> Tensor:
    """Return weighted sums (P, K) of directions (F, K) or (P, F, K) with weights (P, F)."""
    if directions.ndim == 2:
        return weight @ directions
    return (weight[:, None] @ directions)[:, 0]


_PRIOR = 1e-4


def fit_lambertian(
    observations: Tensor, light_directions: Tensor, valid: Tensor | None = None
) -> Tensor:
    """Return the scaled normals b (P, 3) of a robust Lambertian fit: |b| is the albedo, b / |b| the
    normal.

    Each pixel's observations (P, F) are scaled to a largest value of 1; b is (0, 0, tiny) for a
    black pixel. The light directions (F, 3) or (P, F, 3) are unit. By default, all observations are
    valid (P, F).
    """
    observed = observations.T.contiguous()
    lit = torch.where(observed < SHADOW_SHARE, 1e-3, 1.0).to(observed)
    if valid is not None:
        lit = lit * valid.T
    products = direction_products(light_directions)
    # A weak prior towards the previous solution keeps pixels with fewer than three lit observations
    # solvable.
    prior = observed.new_tensor((_PRIOR,) * 3 + (0.0,) * 3)[:, None]
    solution = observed.new_tensor((0.0, 0.0, 1e-3))[:, None].expand(3, len(observations))
    weight = lit
    for iteration in range(5):
        if iteration:
            weight = lit / ((_dot(light_directions, solution) - observed).abs() + 0.02)
        inverse = inverse_3x3((_sum(products, weight) + prior).unbind(), SMALLEST_PIVOT)
        right_side = _sum(light_directions, weight * observed) + _PRIOR * solution
        solution = torch.stack(multiply_symmetric(inverse, right_side.unbind()))
    return solution.T


_TINY = 1e-9


class TwoHalves(NamedTuple):
    """Normals from all lights, and the disagreement between two halves of the lights, with an
    arbitrary sign.
    """

    normals: Tensor  # (P, 3), unit, least squares over all lights
    # (P, 3), relative to the albedo: the least-squares solution for the residuals with their signs
    # flipped in one half. For a ring of lights, it is half the difference between the normals of
    # the two halves
    change: Tensor
    # (P, 1), in radians. Its mean square equals the mean square of the normals' random errors if
    # all observations are equally noisy. It is zero for three lights, which leave no residuals
    noise: Tensor


def compare_halves(observations: Tensor, light_directions: Tensor, signs: Tensor) -> TwoHalves:
    """Return the fit of all lights, and the comparison of the fits of two halves.

    The observations (P, F) of each pixel are scaled to a largest value of 1, and the light
    directions (F, 3) or (P, F, 3) are unit, in float64; observations under shared lights may be
    float32. The signs (F,) are 1 and -1 for the two halves and the same for all pixels of a
    capture; see alternating_signs.
    """
    gram = light_directions.mT @ light_directions
    covariance = torch.linalg.inv(gram + RIDGE * torch.eye(3, dtype=gram.dtype, device=gram.device))

    def solve(values: Tensor) -> Tensor:
        solved: Tensor = weighted_sum(values, light_directions)[:, None] @ covariance
        return solved[:, 0]

    def compare(values: Tensor) -> Tensor:
        scaled = solve(values)
        signed = (values - dot(scaled, light_directions)) * signs
        return torch.cat((scaled, solve(signed), signed.sum(dim=-1, keepdim=True)), dim=1)

    shared = light_directions.ndim == 2
    # It is linear, so it is a single matrix if all pixels have the same lights.
    if shared:
        found = observations @ compare(torch.eye(len(signs)).to(gram)).to(observations)
    else:
        found = compare(observations)
    scaled, change, difference = torch.split(found, [3, 3, 1], dim=1)
    albedo = scaled.norm(dim=-1, keepdim=True).clamp(min=_TINY)
    normals = scaled / albedo
    # The part of the signs that a normal can explain is orthogonal to the residuals. The rest
    # measures the noise.
    signs = signs.to(gram).expand(1 if shared else len(scaled), -1)
    seeing = (signs - dot(solve(signs), light_directions)).norm(dim=-1, keepdim=True)
    spread = covariance.to(scaled)
    turned = normals @ spread if shared else (normals[:, None] @ spread)[:, 0]
    across = spread.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None]
    across = across - (turned * normals).sum(dim=-1, keepdim=True)
    noise = difference / seeing.clamp(min=_TINY).to(scaled) * across.clamp(min=0).sqrt()
    return TwoHalves(normals, change / albedo, noise / albedo)


def alternating_signs(light_directions: Tensor) -> Tensor:
    """Return alternating signs (F,), 1 and -1, for lights (F, 3) ordered by azimuth about their
    mean.

    The light farthest from the mean has 1. Thus, neither the order of the lights nor a rotation of
    the image changes the halves, unless two lights have the same azimuth or distance.
    """
    across = light_directions[:, :2] - light_directions[:, :2].mean(dim=0)
    azimuth = torch.atan2(across[:, 1], across[:, 0])
    turned = (azimuth - azimuth[across.square().sum(dim=1).argmax()]).remainder(2 * math.pi)
    place = turned.argsort().argsort()
    return 1 - 2 * (place % 2).to(light_directions)


# Trimmed LS and IW12 discard observations below this share of the pixel's quantile UNSHADED, as the
# authors of IW12 do.
FIT_SHADOW_SHARE = 0.1


def solve_trimmed(observations: Tensor, light_directions: Tensor) -> Tensor:
    """Return scaled normals b (P, 3) that minimise |I - L b| over the remaining observations.

    Equal observations are kept or discarded together, so the order of the lights does not matter.
    """
    count = observations.shape[1]
    # A fifth is discarded at each end: with ten lights, the two darkest and the two brightest. At
    # least four remain, one more than a normal and an albedo need.
    trimmed = max(0, min(int(0.2 * count), (count - 4) // 2))
    ordered = observations.sort(dim=1).values
    darkest, brightest = ordered[:, trimmed, None], ordered[:, count - 1 - trimmed, None]
    middling = (observations >= darkest) & (observations <= brightest)
    weight = lit_observations(observations, FIT_SHADOW_SHARE, middling)
    scaled_normals, _ = weighted_least_squares(
        observations, light_directions, weight.to(observations.dtype)
    )
    return scaled_normals


def solve_l1(observations: Tensor, light_directions: Tensor) -> Tensor:
    """Return scaled normals b (P, 3) that minimise sum_j |I_j - l_j . b|.

    Iteratively reweighted least squares comes close to the minimum, at which three residuals are
    zero. Therefore, the b for which the three smallest residuals are zero is used if it is better.
    """
    observed, products = observations.T.contiguous(), direction_products(light_directions)

    def fit(weight: Tensor) -> tuple[Tensor, Tensor]:
        solution, _ = _solve(observed, light_directions, weight, products)
        return solution, (observed - _dot(light_directions, solution)).abs()

    weight = torch.ones_like(observed)
    for step in range(50):
        solution, residual = fit(weight)
        # Weights stop growing below a residual of 1e-7, for a largest observation of 1.
        weight = 1 / residual.clamp(min=max(1e-7, 0.1 * 0.5**step))
    three = torch.zeros_like(weight).scatter_(0, weight.topk(3, dim=0).indices, 1.0)
    vertex, residual_there = fit(three)
    return torch.where(residual_there.sum(dim=0) < residual.sum(dim=0), vertex, solution).T


# Smallest variance of an error, for a largest observation of 1. At best, a camera resolves one
# thousandth.
SMALLEST_VARIANCE = 1e-6


def solve_iw12(
    observations: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
    *,
    shadow_share: float = FIT_SHADOW_SHARE,
    iterations: int = 20,
) -> Tensor:
    """Return scaled normals b (P, 3) of I = L b + e, where each sparse error e has its own variance
    gamma.

    b = (L' W L + sigma^2)^-1 L' W I with W = diag(1 / gamma); gamma_k = e_k^2 + var(e_k), where
    var(e) is the diagonal of L (L' W L + sigma^2)^-1 L'. If b explains an observation, the variance
    shrinks and the weight grows. Shadows and highlights keep a large variance.

    The constants require a fixed scale, on which the largest observation of each pixel is 1, so
    bright and dark pixels are treated alike. Variances start at 1, so the first step is least
    squares. sigma is 1e-6 (eq. 12), the ridge of weighted_least_squares. More iterations change the
    normals of real captures by only a few hundredths of a degree on average.

    The observations (P, F), the largest of each pixel 1, and the unit light directions (F, 3) or
    (P, F, 3) are float64. See lit_observations for `valid` and `shadow_share`; 0 keeps all
    observations.
    """
    lit = lit_observations(observations, shadow_share, valid).to(observations.dtype).T.contiguous()
    observed, products = observations.T.contiguous(), direction_products(light_directions)
    # The diagonal of L C L', from the entries of C
    shares = products * products.new_tensor((1.0, 1.0, 1.0, 2.0, 2.0, 2.0))
    variance = torch.ones_like(observed)
    for _ in range(iterations):
        solution, covariance = _solve(observed, light_directions, lit / variance, products)
        error = observed - _dot(light_directions, solution)
        variance = (error.square() + _dot(shares, covariance)).clamp(min=SMALLEST_VARIANCE)
    return solution.T
