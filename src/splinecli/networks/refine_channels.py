"""The channels of the features that the refinement net reads; refinement/features.py computes them."""

from torch import Tensor

WIDTHS = {
    "normal": 3,  # the estimated one
    "robust": 3,  # the normal of the robust Lambertian fit, minus the estimated one
    "plain": 3,  # the normal of least squares, minus the estimated one
    "unexplained_light": 2,  # mean light direction, weighted by what a matte surface with this normal leaves
    "mean_light": 2,
    "light_moments": 3,  # xx, yy and xy of the light directions
    "error_median": 1,  # of the error's distribution; see networks/error_head.py
    "error_shape": 1,
    "largest": 1,  # logarithm of the largest observation, relative to the capture
    "mean": 1,  # of the observations, over the largest; the next two likewise
    "deviation": 1,
    "residual": 1,  # root mean square
    "dark_share": 1,  # share of dark observations
    "n_lights": 1,  # logarithm
    "halves": 3,  # how two halves of the lights differ; the sign means nothing. See TwoHalves
    "noise": 1,  # of least squares. The net does not read it: it serves restore_detail of refinement/detail.py
}
"""The features and their numbers of channels. Vectors have x and y first."""

_VECTORS = ("normal", "robust", "plain", "unexplained_light", "mean_light", "halves")


def channels(name: str) -> slice:
    """Return the channels of a feature."""
    names = list(WIDTHS)
    start = sum(WIDTHS[other] for other in names[: names.index(name)])
    return slice(start, start + WIDTHS[name])


CHANNELS = sum(WIDTHS.values())
READ = channels("noise").start  # number of the channels that the net reads
VECTORS = tuple((channels(name).start, channels(name).start + 1) for name in _VECTORS)
"""Channels that hold the x and y of vectors, and turn with the image."""

_FIRST = channels("light_moments").start
TENSOR = (_FIRST, _FIRST + 1, _FIRST + 2)  # channels that hold the xx, yy and xy of a tensor
_ERROR = slice(channels("error_median").start, channels("error_shape").stop)
MEDIAN_OFFSET = 3.0  # brings the logarithm of usual errors in radians near zero


def split_features(features: Tensor) -> tuple[Tensor, Tensor]:
    """Return normals (B, 3, H, W) and error (B, 2, H, W) from maps of features (B, CHANNELS, H, W)."""
    return features[:, channels("normal")], features[:, _ERROR] + _error_offset(features)


def _error_offset(features: Tensor) -> Tensor:
    return features.new_tensor((-MEDIAN_OFFSET, 1.0))[:, None, None]


def with_refined(features: Tensor, normals: Tensor, error: Tensor) -> Tensor:
    """Return maps of features (B, CHANNELS, H, W) with other normals (B, 3, H, W) and errors (B, 2, H, W).

    What describes how the estimated normal explains the observations stays as it is.
    """
    turned = features[:, channels("normal")] - normals
    changed = features.clone()
    changed[:, channels("normal")] = normals
    for other in ("robust", "plain"):
        changed[:, channels(other)] += turned
    changed[:, _ERROR] = error - _error_offset(features)
    return changed
