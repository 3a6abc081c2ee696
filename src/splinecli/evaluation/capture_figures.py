"""Figures of single captures: the maps of every method for the first draw, and observation maps of some pixels."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, open_capture
from splinecli.errors import UsageError, printable
from splinecli.evaluation.plan import draws_for, read_draws_file
from splinecli.evaluation.protocol import Protocol, heading
from splinecli.evaluation.trial_capture import TrialSource
from splinecli.evaluation.trials import Trial
from splinecli.inference import estimate_normals
from splinecli.methods import Estimator
from splinecli.pictures.method_maps import method_maps
from splinecli.pictures.observation_maps import observation_map_figure
from splinecli.system.files import free_name

SHOWN_PERCENTILES = (10, 50, 90, 99)
"""Percentiles of SPLINE-Net's errors: the pixels that are shown unless others are chosen."""

MAPS = "_observation_maps"
MOST_LISTED = 16  # largest number of lights that a title lists


class CaptureFigure(NamedTuple):
    """A picture: the stem of its file name, its caption, and the PNG."""

    stem: str
    caption: str
    png: bytes


def capture_figures(
    folder: Path,
    name: str,
    stem: str,
    estimators: Sequence[Estimator],
    protocol: Protocol,
    pixels: Sequence[tuple[int, int]],
    advance: Callable[[float], object],
) -> list[CaptureFigure]:
    """Return a figure of the methods' maps for the protocol's first draw; with SPLINE-Net also one of pixels.

    Under near lamps, or with a camera matrix, there is none of pixels. All pixels in the mask are estimated, also where
    the protocol has max_pixels. Raises InputError if the capture cannot be read or scored, or UsageError if a pixel has
    no ground truth.

    Args:
        name: name of the capture in the tables.
        stem: stem of the figures' file names.
        pixels: (row, column) of the pixels whose observation maps are shown; for none, those at SHOWN_PERCENTILES.
        advance: called with the share of the work that was just done.
    """
    source = open_capture(folder, white_level=protocol.white_level)
    read, draws_file = read_draws_file(protocol)
    trial = Trial(name, "", 0, draws_for(source, name, read, draws_file)[0], read, "")
    lights = range(protocol.skipped_lights(name), source.n_lights)
    steps = 1 + len(estimators)
    stored = source.read_stored(lights, lambda: advance(1 / len(lights) / steps))
    capture = TrialSource(stored).see(trial)
    assert capture.ground_truth is not None  # or there is no first trial
    normals: dict[str, NDArray[np.float32]] = {}
    errors_deg: dict[str, NDArray[np.float32]] = {}
    for estimator in estimators:
        estimate = estimate_normals(
            capture, estimator, progress=lambda count: advance(count / capture.n_pixels / steps)
        )
        assert estimate.error_map_deg is not None
        normals[estimator.name], errors_deg[estimator.name] = estimate.normal_map, estimate.error_map_deg
    listed = f" ({', '.join(map(str, trial.lights))})" if len(trial.lights) <= MOST_LISTED else ""
    title = f"{printable(name)}, {heading(protocol)}{listed}"
    png = method_maps(capture.ground_truth, capture.mask, normals, errors_deg, title=title)
    figures = [CaptureFigure(stem, f"{title}. Normal maps above error maps, ground truth at the left.", png)]
    network = next((estimator for estimator in estimators if has_observation_maps(estimator.name)), None)
    # Under near lamps, or before a near camera, each pixel has light directions of its own.
    if network is not None and capture.lamps is None and capture.camera_matrix is None:
        whole = stored.capture if protocol.as_stored else stored.restore(stored.estimate_intensities())
        png = _observation_maps(whole, capture, network, errors_deg[network.name], pixels, title=title)
        caption = f"{title}. Observation maps of single pixels, turned into the network's frame."
        figures.append(CaptureFigure(f"{stem}{MAPS}", caption, png))
    return figures


def has_observation_maps(method: str) -> bool:
    """Return whether a method has observation maps that figures can show."""
    return method.startswith("spline-net")


def file_stems(names: Sequence[str]) -> list[str]:
    """Return a different stem of a file name for each capture, also where names have slashes."""
    stems: list[str] = []
    taken: set[str] = set()
    for name in names:
        stem = free_name(name.replace("/", "_"), lambda stem: not taken.isdisjoint((stem, f"{stem}{MAPS}")), "_")
        taken.update((stem, f"{stem}{MAPS}"))
        stems.append(stem)
    return stems


def _observation_maps(
    whole: Capture,
    capture: Capture,
    estimator: Estimator,
    errors_deg: NDArray[np.float32],
    pixels: Sequence[tuple[int, int]],
    *,
    title: str,
) -> bytes:
    """Return the figure of some pixels. Raises UsageError for one without ground truth."""
    from splinecli.methods.networks import NetworkEstimator

    assert isinstance(estimator, NetworkEstimator)
    for row, column in pixels:
        inside = 0 <= row < errors_deg.shape[0] and 0 <= column < errors_deg.shape[1]
        if not inside or np.isnan(errors_deg[row, column]):
            raise UsageError(
                f"the pixel in row {row}, column {column} of {capture.name} has no ground truth",
                hint="Name pixels on the object, rows from the top and columns from the left, from 0",
            )
    rows, columns = np.array(pixels).T if pixels else np.nonzero(np.isfinite(errors_deg))
    if not pixels:
        order = np.argsort(errors_deg[rows, columns], kind="stable")
        chosen = [order[round(percentile / 100 * (len(order) - 1))] for percentile in SHOWN_PERCENTILES]
        rows, columns = rows[chosen], columns[chosen]
    place = np.cumsum(capture.mask.ravel()).reshape(capture.mask.shape)[rows, columns] - 1
    sparse, dense, truth = estimator.maps(
        capture.observations[place], capture.light_directions, whole.observations[place], whole.light_directions
    )
    return observation_map_figure(
        sparse,
        dense,
        truth if whole.n_lights > capture.n_lights else None,
        pixels=np.stack([rows, columns], axis=1),
        error_deg=errors_deg[rows, columns],
        title=title,
        grid=estimator.network.config.grid,
    )
