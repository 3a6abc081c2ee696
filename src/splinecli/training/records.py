"""What a run leaves for people to watch: metrics.csv, curves.png, maps.png and, on demand, TensorBoard's events."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splinecli.errors import OutputError, UsageError
from splinecli.files import refusals_as_output_errors, write_bytes, write_text
from splinecli.training.validation import SampleMaps

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METRICS = "metrics.csv"
CURVES = "curves.png"
MAPS = "maps.png"
EVENTS = "tensorboard"


@dataclass(frozen=True)
class Metrics:
    """One line of metrics.csv: means over the steps since the last line; angles in degrees.

    loss, symmetric and asymmetric are those of LI-Net and of NE-Net together, where they are updated in turn.

    None for what was not computed: the map errors where there is no LI-Net, the special losses where their weights
    are 0, validation between saves.
    """

    step: int
    pixels: int
    minutes: float
    learning_rate: float
    loss: float
    angle_deg: float
    map_error: float | None
    masked_map_error: float | None
    symmetric: float | None = None
    asymmetric: float | None = None
    validation_deg: float | None = None


class Records:
    """Writes the records of the run in `folder`. Raises OutputError where the system refuses."""

    def __init__(self, folder: Path, step: int, *, tensorboard: bool = False) -> None:
        """Begin at a step: lines of a later one are of a run that was cut off, and are about to come again.

        Raises:
            UsageError: tensorboard is asked for and not installed.
        """
        self.folder = folder
        _drop_lines_after(step, folder / METRICS)
        self._events: Any = _open_events(folder / EVENTS, step) if tensorboard else None

    def append(self, metrics: Metrics) -> None:
        """Add a line to metrics.csv, and to TensorBoard's events."""
        path, row = self.folder / METRICS, vars(metrics)
        try:
            fresh = not path.exists()
            with path.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, row.keys())
                if fresh:
                    writer.writeheader()
                writer.writerow({key: f"{x:.6g}" if isinstance(x, float) else x for key, x in row.items()})
        except OSError as error:
            raise OutputError(f"cannot be written ({error.strerror})", path=path) from error
        if self._events is not None:
            with refusals_as_output_errors(self.folder / EVENTS):
                for key, value in row.items():
                    if value is not None and key != "step":
                        self._events.add_scalar(key, value, metrics.step)
                self._events.flush()

    def draw(self, maps: SampleMaps) -> None:
        """Renew curves.png and maps.png."""
        rows = read_metrics(self.folder / METRICS)
        write_bytes(self.folder / CURVES, _png(curves_figure(rows)))
        write_bytes(self.folder / MAPS, _png(maps_figure(maps)))


def read_metrics(path: Path) -> list[Metrics]:
    """The lines of a metrics.csv."""
    with path.open(newline="", encoding="utf-8") as file:
        return [_parse(row) for row in csv.DictReader(file)]


def _parse(row: dict[str, str]) -> Metrics:
    values: dict[str, Any] = {key: float(value) if value else None for key, value in row.items()}
    return Metrics(**{**values, "step": int(row["step"]), "pixels": int(row["pixels"])})


def curves_figure(rows: list[Metrics]) -> Figure:
    """The loss, the angles and the map errors against the step."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    loss, angle, maps = figure.subplots(1, 3)
    steps = [row.step for row in rows]
    loss.plot(steps, [row.loss for row in rows])
    for name, label in (("symmetric", "Ls"), ("asymmetric", "La")):
        special = [(row.step, value) for row in rows if (value := getattr(row, name)) is not None]
        if special:
            loss.plot(*zip(*special, strict=True), label=f"{label}, unweighted", alpha=0.5)
    loss.lines[0].set_label("whole loss")
    loss.legend()
    loss.set_title("loss")
    angle.plot(steps, [row.angle_deg for row in rows], label="training", alpha=0.5)
    checked = [row for row in rows if row.validation_deg is not None]
    angle.plot(
        [row.step for row in checked], [row.validation_deg for row in checked], "o-", label="validation"
    )
    angle.set_title("mean angular error (deg)")
    for name, label in (("map_error", "all cells"), ("masked_map_error", "cells with a light")):
        known = [(row.step, value) for row in rows if (value := getattr(row, name)) is not None]
        if known:
            maps.plot(*zip(*known, strict=True), label=label)
    maps.set_title("mean error of the dense map")
    maps.set_visible(bool(maps.lines))
    for axes in (loss, angle, maps):
        if not axes.lines:
            continue
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
        values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
        if (values > 0).all() and values.max() > 20 * values.min():
            axes.set_yscale("log")
    angle.legend()
    if maps.lines:
        maps.legend()
    return figure


def maps_figure(maps: SampleMaps) -> Figure:
    """Sparse map, LI-Net's dense map and the true one, a column for each pixel, after the paper's figure 3."""
    from matplotlib.figure import Figure

    shown = {"sparse map": maps.sparse}
    if maps.dense is not None:
        shown["LI-Net's dense map"] = maps.dense
    shown["true map, gaps filled"] = maps.truth
    count = len(maps.sparse)
    figure = Figure(figsize=(1.6 * count + 0.8, 1.8 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), count, squeeze=False)
    for (name, cells), row in zip(shown.items(), axes, strict=True):
        row[0].set_ylabel(name)
        for axis, values in zip(row, cells, strict=True):
            image = axis.imshow(values, vmin=0, vmax=1, cmap="viridis", interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_facecolor("0.85")
    for axis, error_deg in zip(axes[0], maps.error_deg, strict=True):
        axis.set_title(f"{error_deg:.1f} deg", fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.6, label="share of the largest observation")
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _drop_lines_after(step: int, path: Path) -> None:
    if not path.exists():
        return
    header, *lines = path.read_text("utf-8").splitlines() or [""]
    expected = ",".join(field.name for field in fields(Metrics))
    # Of a line that was cut short, on a full disk, the step may lack its last digits.
    whole = [line.split(",") for line in lines if line.count(",") == expected.count(",")]
    kept = [",".join(values) for values in whole if values[0].isdigit() and int(values[0]) <= step]
    if kept and header == expected:
        write_text(path, "\n".join([header, *kept]) + "\n")
    else:  # of a run that ended before its first checkpoint, or of another version
        with refusals_as_output_errors(path):
            path.unlink()


def _open_events(folder: Path, step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise UsageError(
            "--tensorboard needs the package tensorboard",
            hint="Install it: pip install 'splinecli[tensorboard]'",
        ) from error
    with refusals_as_output_errors(folder):
        return SummaryWriter(str(folder), purge_step=step + 1)


def none_for_nan(value: float) -> float | None:
    """None for what was not computed."""
    return None if math.isnan(value) else value
