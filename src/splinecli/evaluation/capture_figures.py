"""Figures of single captures: what every method makes of the first draw, and what SPLINE-Net sees of some pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, open_capture
from splinecli.errors import UsageError
from splinecli.evaluation.records import Protocol
from splinecli.evaluation.run import first_trial, see_trial
from splinecli.evaluation.tables import heading
from splinecli.inference import NormalEstimate, estimate_normals
from splinecli.methods import Estimator
from splinecli.pictures.method_maps import method_maps
from splinecli.pictures.observation_maps import observation_map_figure

SHOWN_PERCENTILES = (10, 50, 90, 99)
"""Of SPLINE-Net's errors: the pixels whose maps are shown unless others are chosen."""

MAPS = "_observation_maps"

MOST_LISTED = 16
"""A title names the lights of a draw up to this many."""


class CaptureFigure(NamedTuple):
    """A picture: its file's stem, what it shows in words, and PNG."""

    stem: str
    caption: str
    png: bytes


def capture_figures(
    folder: Path,
    name: str,
    stem: str,
    estimators: Sequence[Estimator],
    protocol: Protocol,
    pixels: Sequence[tuple[int, int]] = (),
) -> list[CaptureFigure]:
    """The methods' maps under the protocol's first draw, and where SPLINE-Net is among them some pixels' maps.

    All pixels that have ground truth are estimated, whatever the protocol's max_pixels.

    Args:
        name: what the capture is called in the tables; stem: the same as a file's name.
        pixels: row and column of those whose observation maps are shown; by default at the SHOWN_PERCENTILES.

    Raises:
        InputError: the capture cannot be read or scored.
        UsageError: a pixel has no ground truth.
    """
    source = open_capture(folder)
    trial = first_trial(source, name, protocol)
    whole = source.read(range(protocol.skipped_lights(name), source.n_lights), as_stored=True)
    capture = see_trial(whole, trial)
    assert capture.ground_truth is not None  # or there is no first trial
    estimates = {e.name: estimate_normals(capture, e) for e in estimators}
    words = f"{name}, {heading(protocol)}{_listed(trial.lights)}"
    maps = method_maps(
        capture.ground_truth,
        capture.mask,
        {method: estimate.normal_map for method, estimate in estimates.items()},
        {method: _errors(estimate) for method, estimate in estimates.items()},
        title=words,
    )
    figures = [CaptureFigure(stem, f"{words}. Normal maps above error maps, ground truth at the left.", maps)]
    for estimator in estimators:
        if estimator.name == "spline-net":
            png = _observation_maps(whole, capture, estimator, estimates[estimator.name], pixels, title=words)
            caption = f"{words}. Observation maps of single pixels, turned into the network's frame."
            figures.append(CaptureFigure(f"{stem}{MAPS}", caption, png))
    return figures


def file_stems(names: Sequence[str]) -> list[str]:
    """Names of files for captures, all different, whatever letters or slashes the captures' names hold."""
    stems: list[str] = []
    for name in names:
        plain = stem = name.replace("/", "_")
        number = 2
        while {stem, f"{stem}{MAPS}"} & {*stems, *(f"{taken}{MAPS}" for taken in stems)}:
            stem = f"{plain}_{number}"
            number += 1
        stems.append(stem)
    return stems


def _errors(estimate: NormalEstimate) -> NDArray[np.float32]:
    assert estimate.error_map_deg is not None
    return estimate.error_map_deg


def _observation_maps(
    whole: Capture,
    capture: Capture,
    estimator: Estimator,
    estimate: NormalEstimate,
    pixels: Sequence[tuple[int, int]],
    *,
    title: str,
) -> bytes:
    from splinecli.methods.networks import NetworkEstimator

    assert isinstance(estimator, NetworkEstimator)
    errors = _errors(estimate)
    chosen = np.array(pixels or _typical_pixels(errors))
    for row, column in chosen:
        if not (0 <= row < errors.shape[0] and 0 <= column < errors.shape[1]) or np.isnan(
            errors[row, column]
        ):
            raise UsageError(
                f"the pixel in row {row}, column {column} of {capture.name} has no ground truth",
                hint="Name pixels on the object, rows from the top and columns from the left, from 0",
            )
    place = np.cumsum(capture.mask.ravel()).reshape(capture.mask.shape)[chosen[:, 0], chosen[:, 1]] - 1
    sparse, dense, truth = estimator.maps(
        capture.observations[place],
        capture.light_directions,
        whole.observations[place],
        whole.light_directions,
    )
    return observation_map_figure(
        sparse,
        dense,
        truth if whole.n_lights > capture.n_lights else None,
        pixels=chosen,
        error_deg=errors[chosen[:, 0], chosen[:, 1]],
        title=title,
        grid=estimator.network.config.grid,
    )


def _typical_pixels(errors_deg: NDArray[np.float32]) -> list[tuple[int, int]]:
    rows, columns = np.nonzero(np.isfinite(errors_deg))
    order = np.argsort(errors_deg[rows, columns], kind="stable")
    ranks = [order[round(percentile / 100 * (len(order) - 1))] for percentile in SHOWN_PERCENTILES]
    return [(int(rows[rank]), int(columns[rank])) for rank in ranks]


def _listed(lights: Sequence[int]) -> str:
    return f" ({', '.join(map(str, lights))})" if len(lights) <= MOST_LISTED else ""
