"""Estimate and remove the blur of the lens and the Bayer pattern in the images of a capture.

A blur of 0.7 pixels reduces accuracy more than all other faults of a typical capture together,
because it fills shadows, flattens highlights and mixes the outline with the background. Its width
is estimated from the images alone, because edges of shadows and highlights and the outline of the
object are steps on any surface. A Wiener filter then inverts the blur.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from splinecli.maths import Bools, Float32Array, Float64Array
from splinecli.maths.pixel_grid import bounds

# Half of (the side of the filter minus 1), the number of pixels around the object that it uses
REACH = 6
WIDEST_SIGMA = 1.2  # the widest blur of the captures used to fit the estimate
# Mean power of the noise relative to the images, chosen on rendered captures with noise, 8 bits and
# JPEG.
NOISE = 0.005
_SQUARES, _SIDE = 16, 128  # of a larger capture, only this many squares are analysed

# Written by benchmarks/fit_lens_blur.py: mean and standard deviation of each number from
# edge_numbers, and the coefficients of a quadratic polynomial of all five.
_MEANS = (0.5511, 0.6893, 0.5505, 0.1675, 0.01223)
_DEVIATIONS = (0.1537, 0.1952, 0.2823, 0.2043, 0.1355)
_COEFFICIENTS = (
    0.5471,
    0.08626,
    -0.2653,
    0.08725,
    0.1342,
    -0.1189,
    -0.04015,
    0.01734,
    -0.02201,
    0.01165,
    0.01648,
    -0.04393,
    -0.09538,
    0.01304,
    -0.0863,
    -0.02431,
    -0.01935,
    -0.04998,
    0.09267,
    -0.06995,
    0.0123,
)


def surroundings(mask: Bools) -> Bools:
    """Return the pixels (H, W) around a mask that remove_blur needs, without the mask itself."""
    return _grown(mask, REACH) & ~mask


def _grown(mask: Bools, reach: int) -> Bools:
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0


def remove_blur(observations: Float32Array, mask: Bools, around: Bools) -> float | None:
    """Sharpen observations in place; return the estimated blur, or None if it is negligible.

    The observations (P + R, F) are of the P pixels of a mask (H, W), then of the R pixels around it
    (H, W), which keep their values; see surroundings. The blur is its standard deviation along
    either axis, in pixels.
    """
    import cv2

    rows, n_pixels = pixel_rows(mask, around), np.count_nonzero(mask)
    numbers = edge_numbers(observations, mask, rows)
    # A higher correlation of gradients three pixels apart means that there is only shading and no
    # edge, because a blur of up to WIDEST_SIGMA does not reach it.
    if numbers is None or numbers[-1] > 0.5:
        return None
    terms = polynomial(numbers, np.array(_MEANS), np.array(_DEVIATIONS))
    sigma = min(float(terms @ np.array(_COEFFICIENTS)), _widest_at(numbers[2]), WIDEST_SIGMA)
    if sigma < 0.4:  # such a blur does little harm, and its estimate is off by 0.1 to 0.2 pixels
        return None
    box = _box(mask, REACH)
    rows, inside, kernel = rows[box], mask[box], inverse_filter(sigma)

    def sharpen(light: int) -> None:
        image = np.where(rows < 0, np.float32(0), observations[rows, light])
        observations[:n_pixels, light] = cv2.filter2D(
            image, -1, kernel, borderType=cv2.BORDER_REPLICATE
        )[inside]

    with ThreadPoolExecutor(2, "sharpen") as pool:
        list(pool.map(sharpen, range(observations.shape[1])))
    np.maximum(observations[:n_pixels], 0, out=observations[:n_pixels])
    return sigma


def are_soft(observations: Float32Array, mask: Bools, around: Bools) -> bool:
    """Return whether images that show the outline of the object are so blurred that remove_blur
    cannot sharpen them; see there for the arguments.
    """
    numbers = edge_numbers(observations, mask, pixel_rows(mask, around))
    # The steepest steps have 0.36 and 0.78 with a blur of 2 pixels, and 0.41 and 0.5 with a blur of
    # 1.2 pixels. None of 430 photographs and sharp rendered captures exceeds both limits.
    return numbers is not None and bool(numbers[1] < 0.41 and numbers[3] > 0.65)


def polynomial(
    numbers: Float64Array, means: Float64Array, deviations: Float64Array
) -> Float64Array:
    """Return 1, the standardised numbers (..., N) and their products, (..., (N + 1)(N + 2) / 2)."""
    standard = ((numbers - means) / deviations).clip(-3, 3)
    with_one = np.concatenate((np.ones_like(standard[..., :1]), standard), axis=-1)
    first, second = np.triu_indices(with_one.shape[-1])
    return np.asarray(with_one[..., first] * with_one[..., second])


def _widest_at(correlation: float) -> float:
    """Return the widest blur for which gradients of neighbouring pixels can have a correlation this
    low.

    For a given blur, the correlation is lowest on surfaces whose pixels are independent of each
    other. The captures used to fit the polynomial do not have such a fine texture.
    """
    sigmas = np.linspace(0.05, 2, 200)
    # Correlations of values one and two pixels apart
    one, two = np.exp(-1 / (4 * sigmas**2)), np.exp(-1 / sigmas**2)
    of_gradients = (2 * one - 1 - two) / (2 - 2 * one)
    return float(np.interp(correlation + 0.1, of_gradients, sigmas))


def inverse_filter(sigma: float) -> Float32Array:
    """Return the filter (k, k), with a sum of 1, that best inverts a Gaussian blur.

    Among filters of this size, it has the smallest mean square error (Wiener's criterion) for white
    noise and images whose power falls with the square of the frequency, as for edges.
    """
    frequencies = np.arange(33) / 64
    places = np.arange(REACH + 1)
    waves = np.cos(2 * np.pi * frequencies[:, None] * places) * np.where(places > 0, 2, 1)
    # the transfer function of each weight in a quadrant of the filter
    terms = np.kron(waves, waves)
    squared = (frequencies[:, None] ** 2 + frequencies**2).ravel()
    passed = np.exp(-2 * (np.pi * sigma) ** 2 * squared)
    power = 1 / squared.clip(min=frequencies[1] ** 2)
    power /= power.mean()
    weights = np.linalg.solve(
        (terms.T * (power * passed**2 + NOISE)) @ terms, terms.T @ (power * passed)
    )
    mirrored = np.abs(np.arange(-REACH, REACH + 1))
    kernel = weights.reshape(REACH + 1, -1)[mirrored[:, None], mirrored]
    return np.asarray(kernel / kernel.sum(), np.float32)


def edge_numbers(
    observations: Float32Array, mask: Bools, rows: NDArray[np.int32]
) -> Float64Array | None:
    """Return five numbers (5,) that measure the sharpness of a capture's images, or None if there
    are too few edges.

    The first two are the lower and upper quartile, over the steepest local maxima of the gradient
    along rows and columns, of the share of a maximum in the sum of itself and its two neighbours.
    It is 1 for a step between two pixels, and 0.58 with a blur of 0.7 pixels. The others are the
    correlations of gradients of neighbouring pixels in different images, which noise does not
    affect, and of gradients two and three pixels apart in the same image.

    See remove_blur for the observations and the mask, and pixel_rows for the rows. The object and a
    narrow strip around it are analysed, in few images and, in large captures, in few squares.
    Values above the 0.95 quantile are clipped, so that highlights do not dominate.
    """
    n_pixels = np.count_nonzero(mask)
    chosen = observations[:, :: -(-observations.shape[1] // 12)]  # of at most 12 images
    level = max(float(np.quantile(chosen[:n_pixels:7], 0.95)), 1e-12)
    region = _grown(mask, 4)
    boxes = _looked_at(mask, region)
    parts, inside = np.stack([rows[box] for box in boxes]), np.stack([region[box] for box in boxes])
    # (T, F, h, w)
    images = np.moveaxis(
        (chosen[parts] / np.float32(level)).clip(max=1) * (parts >= 0)[..., None], 3, 1
    )
    edges, shares, across, pairs, square, two, three = [], [], 0.0, 0.0, 0.0, 0.0, 0.0
    for axis in (2, 3):
        lines, whole = np.moveaxis(images, axis, 3), np.moveaxis(inside, axis - 1, 2)
        both = whole[..., 1:] & whole[..., :-1]
        steps = np.diff(lines, axis=3) * both[:, None]
        before, middle, after = steps[..., :-2], steps[..., 1:-1], steps[..., 2:]
        size, rising = np.abs(middle), np.sign(middle)
        three_steps = (both[..., :-2] & both[..., 1:-1] & both[..., 2:])[:, None]
        peaks = three_steps & (size >= np.abs(before)) & (size >= np.abs(after)) & (size > 0)
        sums = size + np.maximum(rising * before, 0) + np.maximum(rising * after, 0)
        edges.append(sums[peaks])
        shares.append(size[peaks] / sums[peaks])
        total = steps.sum(axis=1)
        across += _product(total[..., 1:], total[..., :-1]) - _product(
            steps[..., 1:], steps[..., :-1]
        )
        pairs += _product(total, total)
        square += _product(steps, steps)
        two += _product(steps[..., 2:], steps[..., :-2])
        three += _product(steps[..., 3:], steps[..., :-3])
    edge, share = np.concatenate(edges), np.concatenate(shares)
    if len(edge) < 60:
        return None
    steepest = share[edge >= np.quantile(edge, 1 - 0.01)]
    between = across / (pairs - square) if pairs > square else 0.5
    return np.array([*np.quantile(steepest, (0.25, 0.75)), between, two / square, three / square])


def _product(one: Float32Array, other: Float32Array) -> float:
    return float((one * other).sum(dtype=np.float64))


def pixel_rows(mask: Bools, around: Bools) -> NDArray[np.int32]:
    """Return the row of each pixel (H, W) in the observations of remove_blur, -1 for pixels without
    one.
    """
    rows = np.full(mask.shape, -1, np.int32)
    n_pixels = np.count_nonzero(mask)
    rows[mask] = np.arange(n_pixels, dtype=np.int32)
    rows[around] = n_pixels + np.arange(np.count_nonzero(around), dtype=np.int32)
    return rows


def _looked_at(mask: Bools, region: Bools) -> list[tuple[slice, slice]]:
    """Return the parts (y, x) of a capture used to measure its blur: all of it, or squares of equal
    size.
    """
    box = _box(region, 0)
    if region[box].size <= _SQUARES * _SIDE**2:
        return [box]
    places = np.flatnonzero(mask)[
        np.linspace(0, np.count_nonzero(mask) - 1, _SQUARES + 2).astype(int)[1:-1]
    ]
    corners = np.stack(np.divmod(places, mask.shape[1]), axis=1) - _SIDE // 2
    corners = corners.clip(0, np.maximum(np.array(mask.shape) - _SIDE, 0))
    return [(slice(y, y + _SIDE), slice(x, x + _SIDE)) for y, x in corners.tolist()]


def _box(mask: Bools, margin: int) -> tuple[slice, slice]:
    """Return the part (y, x) of an image that contains a mask (H, W) and a margin of so many
    pixels.
    """
    y, x = (
        slice(max(first - margin, 0), last + margin + 1)
        for first, last in (side.tolist() for side in bounds(mask))
    )
    return y, x
