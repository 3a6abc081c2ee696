"""Angular errors of normals, in degrees."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.maths.normals import angle_between_deg


@dataclass(frozen=True)
class AngularErrors:
    """Statistics of the angular error over the pixels that have a ground truth.

    Args:
        mean, median, p90: mean (MAE), median and 90th percentile, in degrees.
        under_5, under_10: shares of the pixels, 0 to 1, with an error below 5 and below 10 degrees.
    """

    mean: float
    median: float
    p90: float
    under_5: float
    under_10: float


def angular_error_map_deg(
    normals: NDArray[np.floating], ground_truth: NDArray[np.floating], mask: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the angular errors (H, W) of a normal map (H, W, 3) in degrees.

    They are NaN outside the mask (H, W) and where the ground truth (H, W, 3) is zero. The sign of a normal counts: one
    that points the opposite way has an error of 180 degrees, not 0.
    """
    scored = mask & ground_truth.any(axis=-1)
    errors = np.full(mask.shape, np.nan, np.float32)
    # Row by row, because a map of many megapixels in float64 would need several gigabytes.
    for row, row_scored, row_normals, row_truth in zip(errors, scored, normals, ground_truth, strict=True):
        row[row_scored] = angle_between_deg(row_normals[row_scored], row_truth[row_scored])
    return errors


def summarise_errors(errors_deg: NDArray[np.floating]) -> AngularErrors | None:
    """Return the statistics of angular errors in degrees of any shape, without NaN; None if all are NaN."""
    errors = errors_deg[np.isfinite(errors_deg)].astype(np.float64)
    if not errors.size:
        return None
    return AngularErrors(
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        p90=float(np.percentile(errors, 90)),
        under_5=float((errors < 5).mean()),
        under_10=float((errors < 10).mean()),
    )
