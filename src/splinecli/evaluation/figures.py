"""Draw the figures of evaluations (the error against a setting, maps and observation maps of single
captures), and score relighting.

Curves include only the captures that all evaluations scored, so that all points of an average refer
to the same captures. Relighting compares photographs under lights that are not in a draw with
pictures of the material estimated from the draw.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.errors import UsageError, printable
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import METHODS, Estimator
from splinecli.evaluation.protocol import Evaluation, Protocol, heading, lights_value
from splinecli.evaluation.run import read_first_draw
from splinecli.evaluation.tables import AVERAGE, trial_averages
from splinecli.maths import Float32Array, Floats
from splinecli.pictures.plots import method_maps, method_styles, observation_map_figure, png_bytes
from splinecli.recipe.steps import follow
from splinecli.records.documents import Likeness, RelightingReport
from splinecli.results.map_values import agreeing_lights
from splinecli.results.material import material_of
from splinecli.system.files import free_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Up to this number, each capture has a panel. With more, only the average is plotted.
MOST_CAPTURES = 4
_PANEL_INCHES = (3.2, 2.7)
_SMALL, _LARGE = 8, 9  # font sizes in points, as in the figures of papers
# Dashes for matplotlib: an offset, then lengths of dashes and gaps in line widths
_DASHES: tuple[tuple[float, tuple[float, ...]], ...] = (
    (0, ()),
    (0, (4, 2)),
    (0, (1, 1.5)),
    (0, (5, 1.5, 1, 1.5)),
)


def lights_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Return a PNG of the error against the number of lights K, on a logarithmic axis.

    Each capture has a panel, and so does their average. With one capture, or more than
    MOST_CAPTURES, only the average has a panel. "all" is plotted at the capture's number of lights,
    and in the panel of the average at the mean number. If the light noise also varies, each value
    has its own dash pattern.
    """
    return _curves(
        evaluations,
        x=lambda e, capture: float(
            np.mean([r.n_lights for r in e.results if capture in (AVERAGE, r.capture)])
        ),
        tick=lambda e, x: f"{x:.0f}\n(all)" if e.protocol.n_lights is None else f"{x:g}",
        series=lambda e: f"light noise {e.protocol.light_noise_deg:g} deg",
        label="number of lights",
        logarithmic=True,
    )


def light_noise_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Return a PNG of the error against the light noise, with the same panels as lights_curves.

    If the number of lights also varies, each number has its own dash pattern.
    """
    return _curves(
        evaluations,
        x=lambda e, _: e.protocol.light_noise_deg,
        tick=lambda _, x: f"{x:g}",
        series=lambda e: f"{lights_value(e.protocol)} lights",
        label="light noise (standard deviation, deg)",
        logarithmic=False,
    )


def _curves(
    evaluations: Sequence[Evaluation],
    *,
    x: Callable[[Evaluation, str], float],
    tick: Callable[[Evaluation, float], str],
    series: Callable[[Evaluation], str],
    label: str,
    logarithmic: bool,
) -> bytes:
    """Return a PNG of panels side by side, with one curve for each method and series, and one
    legend.

    Each curve has a band of one standard deviation on either side. Its colour and marker indicate
    the method, and its dashes the series. `x` returns the position of an evaluation on the x axis
    of a capture, `tick` its label there, and `series` the name of its series.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    common = set.intersection(*(set(evaluation.captures) for evaluation in evaluations))
    evaluations = [
        replace(e, results=tuple(r for r in e.results if r.capture in common)) for e in evaluations
    ]
    captures = evaluations[0].captures
    shown = [*captures, AVERAGE] if 1 < len(captures) <= MOST_CAPTURES else [AVERAGE]
    styles = method_styles(evaluations[0].methods)
    dashes = {
        name: _DASHES[i % len(_DASHES)]
        for i, name in enumerate(dict.fromkeys(map(series, evaluations)))
    }
    across = 2 if len(shown) == 4 else min(len(shown), 3)
    down = math.ceil(len(shown) / across)

    figure = Figure(
        figsize=(_PANEL_INCHES[0] * across, _PANEL_INCHES[1] * down + 0.4), layout="constrained"
    )
    for capture, axes in zip_longest(shown, figure.subplots(down, across, squeeze=False).flat):
        if capture is None:
            axes.set_axis_off()
            continue
        in_order = sorted(evaluations, key=lambda e: x(e, capture))
        for method, style in styles.items():
            for name, pattern in dashes.items():
                points = [
                    (x(e, capture), *_error(e, method, capture))
                    for e in in_order
                    if series(e) == name
                ]
                place, mae_deg, std_deg = np.array(points).T
                line = {"color": style.colour, "marker": style.marker, "linestyle": pattern}
                axes.plot(place, mae_deg, markersize=4, linewidth=1.2, **line)
                if std_deg.any():
                    low, high = mae_deg - std_deg, mae_deg + std_deg
                    axes.fill_between(place, low, high, color=style.colour, alpha=0.2, linewidth=0)
        _set_ticks(
            axes, {x(e, capture): tick(e, x(e, capture)) for e in in_order}, logarithmic=logarithmic
        )
        average = captures[0] if len(captures) == 1 else f"average of {len(captures)} captures"
        title = average if capture == AVERAGE else capture
        axes.set_title(printable(title), fontsize=_LARGE, parse_math=False)
        axes.set_xlabel(label, fontsize=_SMALL)
        axes.set_ylabel("mean angular error (deg)", fontsize=_SMALL)
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize=_SMALL)
        axes.grid(alpha=0.3)
    handles = [  # a dollar sign would start a formula
        Line2D(
            [],
            [],
            color=style.colour,
            marker=style.marker,
            markersize=4,
            label=method.replace("$", r"\$"),
        )
        for method, style in styles.items()
    ]
    if len(dashes) > 1:
        handles += [
            Line2D([], [], color="0.3", linestyle=style, label=name)
            for name, style in dashes.items()
        ]
    columns = min(len(handles), 2 * across)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=_SMALL)
    return png_bytes(figure, 200)


def _error(evaluation: Evaluation, method: str, capture: str) -> tuple[float, float]:
    """Return the mean error of a method on a capture or the average, and its standard deviation.

    The standard deviation is over the trials.
    """
    if capture == AVERAGE:
        return evaluation.averages[method], float(np.std(trial_averages(evaluation, method)))
    result = next(r for r in evaluation.results if (r.method, r.capture) == (method, capture))
    return result.mae_deg, result.std_deg


def _set_ticks(axes: Axes, ticks: dict[float, str], *, logarithmic: bool) -> None:
    """Set ticks at the points, in ascending order, and leave out labels that would overlap."""
    from matplotlib.ticker import NullLocator

    if logarithmic:
        axes.set_xscale("log", base=2)
    place = {x: math.log2(x) if logarithmic else x for x in ticks}
    span = max(place.values()) - min(place.values())
    labels, last = [], -math.inf
    for x, position in place.items():
        # Labels closer than this fraction of the axis would overlap.
        fits = position - last > 0.045 * span
        labels.append(ticks[x] if fits else "")
        last = position if fits else last
    axes.set_xticks(list(place), labels)
    axes.xaxis.set_minor_locator(NullLocator())


# Percentiles of SPLINE-Net's errors, whose pixels are shown by default
SHOWN_PERCENTILES = (10, 50, 90, 99)
MAPS = "_observation_maps"


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
    """Return a figure of the methods' maps for the protocol's first draw, and one of single pixels.

    The figure of single pixels needs SPLINE-Net, and is omitted under near lamps or with a camera
    matrix. Its pixels are given as (row, column), or are those at SHOWN_PERCENTILES. All pixels in
    the mask are estimated, even if the protocol has max_pixels. `name` is the capture's name in the
    tables, and `stem` is the stem of the files. `advance` is called with the fraction of the work
    just completed. Raises InputError if the capture cannot be read or scored, or UsageError if a
    pixel has no ground truth.
    """
    steps = 1 + len(estimators)
    stored, capture = read_first_draw(folder, name, protocol, lambda share: advance(share / steps))
    assert capture.ground_truth is not None  # otherwise there would be no first trial
    normals: dict[str, NDArray[np.float32]] = {}
    errors_deg: dict[str, NDArray[np.float32]] = {}
    for estimator in estimators:
        estimate = estimate_normals(
            capture, estimator, progress=lambda count: advance(count / capture.n_pixels / steps)
        )
        assert estimate.error_map_deg is not None
        normals[estimator.name], errors_deg[estimator.name] = (
            estimate.normal_map,
            estimate.error_map_deg,
        )
    # At most 16 lights are listed in a title.
    listed = f" ({', '.join(map(str, capture.light_indices))})" if capture.n_lights <= 16 else ""
    title = f"{printable(name)}, {heading(protocol)}{listed}"
    png = method_maps(capture.ground_truth, capture.mask, normals, errors_deg, title=title)
    figures = [
        CaptureFigure(
            stem, f"{title}. Normal maps above error maps, ground truth at the left.", png
        )
    ]
    network = next(
        (e for e in estimators if e.name in METHODS and METHODS[e.name].observation_maps), None
    )
    # Under near lamps, or with a near camera, each pixel has its own light directions.
    if network is not None and capture.lamps is None and capture.camera_matrix is None:
        whole = follow(
            replace(stored, options=protocol.recipe), "intensities", until="judgement"
        ).made
        png = _observation_maps(
            whole, capture, network, errors_deg[network.name], pixels, title=title
        )
        caption = f"{title}. Observation maps of single pixels, rotated to the network's frame."
        figures.append(CaptureFigure(f"{stem}{MAPS}", caption, png))
    return figures


def file_stems(names: Sequence[str]) -> list[str]:
    """Return a unique stem of file names for each capture, even if the names contain slashes."""
    stems: list[str] = []
    taken: set[str] = set()
    for name in names:
        stem = free_name(
            name.replace("/", "_"), lambda stem: not taken.isdisjoint((stem, f"{stem}{MAPS}")), "_"
        )
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
    """Return the figure for the given pixels. Raises UsageError for a pixel without ground
    truth.
    """
    for row, column in pixels:
        inside = 0 <= row < errors_deg.shape[0] and 0 <= column < errors_deg.shape[1]
        if not inside or np.isnan(errors_deg[row, column]):
            problem = (
                f"the pixel in row {row}, column {column} of {capture.name} has no ground truth"
            )
            hint = (
                "Choose pixels on the object, counting rows from the top and columns from the left,"
                " from 0"
            )
            raise UsageError(problem, hint=hint)
    rows, columns = np.array(pixels).T if pixels else np.nonzero(np.isfinite(errors_deg))
    if not pixels:
        order = np.argsort(errors_deg[rows, columns], kind="stable")
        chosen = [
            order[round(percentile / 100 * (len(order) - 1))] for percentile in SHOWN_PERCENTILES
        ]
        rows, columns = rows[chosen], columns[chosen]
    place = np.cumsum(capture.mask.ravel()).reshape(capture.mask.shape)[rows, columns] - 1
    maps = estimator.observation_maps(
        capture.observations[place],
        capture.light_directions,
        whole.observations[place],
        whole.light_directions,
    )
    assert maps is not None
    return observation_map_figure(
        maps.sparse,
        maps.dense,
        {"true map, all lights": maps.every} if whole.n_lights > capture.n_lights else {},
        pixels=np.stack([rows, columns], axis=1),
        error_deg=errors_deg[rows, columns],
        title=title,
        grid=maps.grid,
    )


def relight_first_draw(
    folder: Path,
    name: str,
    estimator: Estimator,
    protocol: Protocol,
    advance: Callable[[float], object],
) -> RelightingReport:
    """Return how well the material predicts the photographs under the lights not in the first draw.

    The material is estimated from the protocol's first draw. `name` is the capture's name in the
    tables, and `advance` is called with the fraction of the images just read. Raises UsageError if
    no light is left, or if the lamps or the camera are near; InputError if the capture cannot be
    read, or if there are too few lights.
    """
    from splinecli.materials.maps import lights_that_reach, render_gray

    stored, given = read_first_draw(folder, name, protocol, advance)
    whole = stored.made
    held = [
        place for place, light in enumerate(whole.light_indices) if light not in given.light_indices
    ]
    if not held:
        raise UsageError(
            f"{name}: the draw uses all lights, so none is held out",
            hint="Use a smaller --n-lights",
        )
    if whole.lamps is not None or whole.camera_matrix is not None:
        raise UsageError(f"{name}: --relight needs distant lights and an orthographic camera")
    estimate = estimate_normals(given, estimator)
    normals = estimate.normal_map[given.mask]
    confidence = None if estimate.confidence_map is None else estimate.confidence_map[given.mask]
    lights = whole.light_directions[held]
    reached = lights_that_reach(estimate.normal_map, given.mask, lights)
    nearest = (lights @ given.light_directions.T).argmax(axis=1)
    judge = partial(likeness, whole.observations[:, held])
    return RelightingReport(
        capture=name,
        method=estimator.name,
        lights=list(given.light_indices),
        held_out=len(held),
        material=judge(render_gray(material_of(estimate), normals, lights, reached, confidence)),
        lambertian=judge(lambertian(given, normals, lights) * reached),
        nearest=judge(given.observations[:, nearest]),
    )


def likeness(photographs: Float32Array, pictures: Float32Array) -> Likeness:
    """Compare pictures with photographs, both (P, F) and linear. The photographs are not all black.

    White is the 0.999 quantile of the photographs; brighter values are clipped.
    """
    white = max(float(np.quantile(photographs, 0.999)), 1e-12)
    wrong = np.minimum(pictures, white) - np.minimum(photographs, white)
    square = max(float(np.square(wrong, dtype=np.float64).mean()) / white**2, 1e-12)
    error = float(np.abs(wrong).mean() / photographs.mean())
    return Likeness(psnr_db=round(-10 * float(np.log10(square)), 2), error=round(error, 4))


def lambertian(given: Capture, normals: Float32Array, lights: Floats) -> Float32Array:
    """Return pictures (P, F) of a matte surface under lights (F, 3), with the albedo computed by
    `infer`.
    """
    cosines = (normals @ given.light_directions.T).astype(np.float32)
    weights = agreeing_lights(given.observations, cosines) * cosines
    albedo = (weights * given.observations).sum(axis=1) / np.maximum(
        (weights * cosines).sum(axis=1), 1e-6
    )
    return np.asarray(albedo[:, None] * (normals @ lights.T).clip(0), np.float32)
