"""Plots of light directions, observation maps, learning curves, and maps of several methods."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from splinecli.capture.formats.images import read_image
from splinecli.errors import printable
from splinecli.estimate.methods import method_names
from splinecli.maths import Bools, Float64Array, Floats, Integers, Picture
from splinecli.maths.normals import encode_picture, unit
from splinecli.pictures.maps import TICKS, TITLE, TOP_DEG, bounding_box, colour_errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from splinecli.lights.calibration.balls import BallCalibration
    from splinecli.maths.observation_map import Grid


class MethodStyle(NamedTuple):
    """The style of a line: matplotlib's names of a colour and a marker."""

    colour: str
    marker: str


# The colours of Okabe and Ito ("Color Universal Design", 2008), which colour-blind readers can
# distinguish. Their yellow is replaced with gray, because it is too light for lines on white. The
# markers are for prints without colour.
_COLOURS = [
    "#D55E00",
    "#0072B2",
    "#000000",
    "#009E73",
    "#CC79A7",
    "#56B4E9",
    "#E69F00",
    "#808080",
    "#7F5F3F",
]
_STYLES = tuple(map(MethodStyle, _COLOURS, "osD^vXP*h"))


def method_styles(methods: Sequence[str]) -> dict[str, MethodStyle]:
    """Return the style of each method, which is the same in every plot.

    It depends on the order in the registry. Names that are not in the registry follow in their
    order.
    """
    known = method_names()
    places = known + [name for name in methods if name not in known]
    return {name: _STYLES[places.index(name) % len(_STYLES)] for name in methods}


def png_bytes(figure: Figure, dpi: int) -> bytes:
    """Return a figure as a PNG file, on white regardless of the user's matplotlibrc."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Characters that are missing in the font, for example in a capture's name, appear as boxes.
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()


def sky_plot(
    light_directions: Float64Array, title: str, *, errors_deg: Float64Array | None = None
) -> bytes:
    """Return a PNG of the light directions (F, 3) at their (x, y), numbered from 1.

    The rings are angles from the viewing direction in degrees. With expected errors (F,), a circle
    of this radius is drawn around each light.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    angle = np.linspace(0, 2 * np.pi, 361)
    for ring_deg in (15, 30, 45, 60, 75, 90):
        radius = np.sin(np.radians(ring_deg))
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        axes.plot(x, y, color="0.8", linewidth=1, zorder=1)
        if ring_deg < 90:  # the labels of 90 and 75 degrees would overlap
            axes.text(0, -radius, f"{ring_deg}°", color="0.5", fontsize=8, ha="center", va="bottom")
    x, y = light_directions[:, 0], light_directions[:, 1]
    if errors_deg is not None:  # draw circles on the sphere around the directions
        radii = np.radians(errors_deg)[:, None, None]
        smallest = np.abs(light_directions).argmin(axis=1)
        across = unit(np.cross(light_directions, np.eye(3)[smallest]))
        turned = np.cross(light_directions, across)
        around = across[:, None] * np.cos(angle)[:, None] + turned[:, None] * np.sin(angle)[:, None]
        for outline in light_directions[:, None] * np.cos(radii) + around * np.sin(radii):
            axes.plot(*outline[:, :2].T, color="#D55E00", alpha=0.4, linewidth=1, zorder=2)
    axes.scatter(x, y, s=30, color="#D55E00", zorder=3)
    for number, place in enumerate(zip(x, y, strict=True), start=1):
        axes.annotate(
            str(number), place, xytext=(4, 4), textcoords="offset points", fontsize=7, zorder=3
        )
    axes.set_title(printable(title), parse_math=False)
    axes.set_axis_off()
    return png_bytes(figure, 120)


_SMALL = 8  # points


def observation_map_figure(
    sparse: Floats,
    dense: Floats | None,
    truth: Mapping[str, Floats],
    *,
    error_deg: Floats,
    pixels: Integers | None = None,
    title: str = "",
    grid: Grid = "even",
) -> bytes:
    """Return a PNG file with a row of observation maps for each of N pixels.

    The columns are the sparse map, the dense map of LI-Net, and the map of all lights. Row 0 of a
    map is y = +1. All maps of a pixel have the same frame, either the camera's or the pixel's.
    Values are relative to the largest observation, from 0 to 1. Empty cells are gray; the circle is
    the horizon.

    Args:
        sparse: (N, w, w), NaN in empty cells.
        dense: the same; None for a network without a LI-Net.
        truth: true maps (N, w, w) by label, NaN in cells without a value; may be empty.
        error_deg: (N,) errors of the estimated normals, in degrees.
        pixels: (N, 2) row and column in the image; None to leave them out.
        title: title of the figure; empty for none.
        grid: how light directions are assigned to cells.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    columns = {"sparse map": sparse}
    if dense is not None:
        columns["LI-Net's dense map"] = dense
    columns |= truth
    size_inches = 1.7 * len(columns) + 0.8, (1.7 + 0.25) * len(sparse) + 0.7
    figure = Figure(figsize=size_inches, layout="constrained")
    if title:
        figure.suptitle(title, fontsize=9, parse_math=False)
    # In matplotlib, cell k extends from k - 1/2 to k + 1/2. In the authors' grid, the last column
    # and the top row represent single lines.
    size = sparse.shape[1]
    centre, radius = (size / 2 - 0.5, size / 2 - 0.5), size / 2
    if grid == "cnn-ps":
        centre, radius = (size / 2 - 1, size / 2), (size - 1) / 2
    axes = figure.subplots(len(sparse), len(columns), squeeze=False)
    for place, (name, maps) in enumerate(columns.items()):
        for axis, values in zip(axes[:, place], maps, strict=True):
            image = axis.imshow(values, vmin=0, vmax=1, cmap="viridis", interpolation="nearest")
            # Light gray is not part of the colour scale.
            axis.set(xticks=[], yticks=[], facecolor="0.85")
            line = {"edgecolor": "black", "linewidth": 0.8, "clip_on": False}
            axis.add_patch(Circle(centre, radius, fill=False, **line))
        axes[-1, place].set_xlabel(name, fontsize=_SMALL)
    for number, error in enumerate(error_deg):
        where = "" if pixels is None else "row {}, column {}: ".format(*pixels[number])
        axes[number, 0].set_title(f"{where}{error:.1f} deg off", fontsize=_SMALL, loc="left")
    bar = figure.colorbar(image, ax=axes, shrink=min(1, 2 / len(sparse)), aspect=25)
    bar.set_label("relative to the largest observation", fontsize=_SMALL)
    bar.ax.tick_params(labelsize=_SMALL)
    return png_bytes(figure, 150)


Columns = Mapping[str, Sequence[float | None]]


def training_figure(columns: Columns) -> Figure:
    """Return a figure of the loss, the angular errors and the map errors against the step.

    `columns` contains the columns of metrics.csv by name, all of the same length; None marks a
    value that was not computed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    loss, angle, maps = figure.subplots(1, 3)
    for axes, name, label, style, alpha in (
        (loss, "loss", "weighted sum", "-", 1),
        (loss, "symmetric", "Ls, unweighted", "-", 0.5),
        (loss, "asymmetric", "La, unweighted", "-", 0.5),
        (angle, "angle_deg", "training", "-", 0.5),
        (angle, "validation_deg", "validation", "o-", 1),
        (maps, "map_error", "all cells", "-", 1),
        (maps, "masked_map_error", "cells with a light", "-", 1),
    ):
        pairs = zip(columns["step"], columns[name], strict=True)
        points = [(step, value) for step, value in pairs if value is not None]
        if points:
            style = "o" if len(points) == 1 else style  # a single point is not a line
            axes.plot(*zip(*points, strict=True), style, label=label, alpha=alpha)
    titles = ("loss", "mean angular error (deg)", "mean error of the dense map")
    for axes, title in zip((loss, angle, maps), titles, strict=True):
        axes.set_visible(bool(axes.lines))
        if not axes.lines:
            continue
        axes.set(title=title, xlabel="step")
        axes.grid(alpha=0.3)
        axes.legend()
        values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
        if (values > 0).all() and values.max() > 20 * values.min():
            axes.set_yscale("log")
    return figure


_MAPS_DPI = 100


def method_maps(
    ground_truth: Floats,
    mask: Bools,
    normal_maps: Mapping[str, Floats],
    error_maps_deg: Mapping[str, Floats],
    *,
    title: str,
) -> bytes:
    """Return a PNG file of the ground truth and the maps of several methods, side by side.

    Each column has a normal map above an error map. Normals have the colours (n + 1) / 2, and
    errors the scale of colour_errors from 0 to TOP_DEG; other pixels are white. The maps are
    cropped to the mask's bounding box. Small maps are enlarged by an integer factor and large ones
    averaged, so that the picture stays below 4000 pixels wide. The MAE below each method refers to
    the pixels that have errors.

    The ground truth (H, W, 3) is unit, or zero where it is unknown; the mask (H, W) is not empty.
    Each method, in the order of the columns, has normals (H, W, 3) and errors (H, W), NaN in pixels
    without an error.
    """
    from matplotlib.figure import Figure

    box = bounding_box(mask)
    height, width = mask[box].shape
    scale = _scale(height, width, columns=1 + len(normal_maps))
    known = mask[box] & ground_truth[box].any(axis=-1)
    truth = _resize(_colour_normals(ground_truth[box], known), scale)
    shown_deg = {name: np.where(mask, error_maps_deg[name], np.nan) for name in normal_maps}
    captions = {name: f"MAE {np.nanmean(shown_deg[name]):.2f}°" for name in normal_maps}

    # pixels: room for the colour bar and a name
    cell_height, cell_width = (max(side, 150) for side in truth.shape[:2])
    text = _text_height(cell_width, ["ground truth", *captions, *captions.values()])
    gap, line = text // 2, 2 * text
    errors_at = gap + line  # from the bottom, as in matplotlib
    normals_at = errors_at + cell_height + gap
    names_at = normals_at + cell_height
    width, height = gap + (cell_width + gap) * (1 + len(normal_maps)), names_at + 2 * line
    figure = Figure(figsize=(width / _MAPS_DPI, height / _MAPS_DPI), dpi=_MAPS_DPI)

    def show(picture: Picture, left: int, bottom: int) -> None:
        x = left + (cell_width - picture.shape[1]) // 2
        y = bottom + (cell_height - picture.shape[0]) // 2
        figure.figimage(picture[::-1], x, y, origin="lower")

    show(truth, gap, normals_at)
    _write(figure, gap + cell_width / 2, names_at + text, "ground truth", text)
    _draw_bar(figure, gap + cell_width - text, errors_at, cell_height, text)
    for column, name in enumerate(normal_maps, start=1):
        left = gap + column * (cell_width + gap)
        normals = _colour_normals(normal_maps[name][box], mask[box])
        show(_resize(normals, scale), left, normals_at)
        show(_resize(colour_errors(shown_deg[name][box]), scale), left, errors_at)
        _write(figure, left + cell_width / 2, names_at + text, name, text)
        _write(figure, left + cell_width / 2, errors_at - text, captions[name], text)
    size = _text_height(width, [title], most=round(1.2 * text))
    _write(figure, width / 2, height - text, title, size)
    return png_bytes(figure, _MAPS_DPI)


def _draw_bar(figure: Figure, left: int, bottom: int, height: int, text: int) -> None:
    """Draw a vertical colour bar of errors, `text` pixels wide, with labels and title on its
    left.
    """
    inset = text // 2  # room for half a label at either end
    column = _bar(height - 2 * inset, text)
    figure.figimage(column, left, bottom + inset)
    for value, label in TICKS.items():
        y = bottom + inset + value / TOP_DEG * (len(column) - 1)
        _write(figure, left - 0.4 * text, y, label, text, ha="right")
    size = _text_height(height, [TITLE], most=text)
    _write(figure, left - 3 * text, bottom + height / 2, TITLE, size, rotation=90)


def _bar(height: int, width: int) -> Picture:
    return colour_errors(np.linspace(TOP_DEG, 0, height)[:, None].repeat(width, axis=1))


def error_map_picture(error_map_deg: Floats) -> Picture:
    """Return an error map (H, W) in degrees as an RGB picture with a colour bar on its right.

    A map of fewer than 256 rows is enlarged by an integer factor while its width stays within 1024
    pixels, then padded to 256 rows.
    """
    # Loading matplotlib takes longer than everything else that is drawn for a capture.
    from PIL import Image, ImageDraw, ImageFont

    picture = colour_errors(error_map_deg)
    height, width = picture.shape[:2]
    factor = max(1, min(-(-256 // height), 1024 // width))
    picture = _resize(picture, factor)
    missing = max(0, 256 - len(picture))
    margins = ((missing // 2, missing - missing // 2), (0, 0), (0, 0))
    picture = np.pad(picture, margins, constant_values=255)
    height = len(picture)
    text = max(18, height // 22)
    bar = _bar(height - 2 * text, text)
    panel = Image.new("RGB", (6 * text, height), "white")
    panel.paste(Image.fromarray(bar), (text // 2, text))
    draw, font = ImageDraw.Draw(panel), ImageFont.load_default(text)
    for value, label in TICKS.items():
        y = text + (1 - value / TOP_DEG) * (len(bar) - 1)
        draw.text((1.9 * text, y), label, "black", font, anchor="lm")
    title = Image.new("RGB", (height, 2 * text), "white")
    font = ImageFont.load_default(_text_height(height, [TITLE], most=text))
    ImageDraw.Draw(title).text((height / 2, text), TITLE, "black", font, anchor="mm")
    panel.paste(title.rotate(90, expand=True), (round(3.7 * text), 0))
    return np.hstack([picture, np.asarray(panel)])


def calibration_picture(balls: Sequence[BallCalibration]) -> bytes:
    """Return a PNG file with all images of all balls, in rows of up to six.

    The green circle is the outline, and the red one the highlight. The red line from the centre to
    the highlight points towards the lamp. The title contains the number of the image, from 1, and
    the light direction x, y, z. Images whose highlights were not found show the outline only.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    columns = min(6, max(len(ball.files.images) for ball in balls))
    places = [-(-len(ball.files.images) // columns) for ball in balls]
    figure = Figure(figsize=(2 * columns, 2.25 * sum(places)), layout="constrained")
    grid = figure.subplots(sum(places), columns, squeeze=False)
    for axis in grid.flat:
        axis.set_axis_off()
    for first, ball in zip(np.cumsum([0, *places]), balls, strict=False):
        circle = ball.circle
        for number, path in enumerate(ball.files.images):
            axis = grid[first:].flat[number]
            reach = 1.15 * circle.radius
            left, top = max(0, int(circle.x - reach)), max(0, int(circle.y - reach))
            image = read_image(path)
            image = image[top : int(circle.y + reach) + 2, left : int(circle.x + reach) + 2]
            gray = image.mean(axis=2) ** 0.4  # so that the outline of a dark ball shows
            height, width = gray.shape
            extent = (left - 0.5, left + width - 0.5, top + height - 0.5, top - 0.5)
            axis.imshow(gray, cmap="gray", vmin=0, extent=extent)
            axis.set_xlim(circle.x - reach, circle.x + reach)
            axis.set_ylim(circle.y + reach, circle.y - reach)
            axis.add_patch(Circle((circle.x, circle.y), circle.radius, fill=False, color="#5AC85A"))
            title = f"{number + 1}"
            if number < len(ball.highlights):
                highlight, (x, y, z) = ball.highlights[number], ball.directions[number]
                x_line, y_line, red = [circle.x, highlight.x], [circle.y, highlight.y], "#FF3C3C"
                axis.plot(x_line, y_line, color=red, linewidth=1)
                axis.plot(highlight.x, highlight.y, "o", color=red, markersize=6, fillstyle="none")
                title += f":  {x:+.2f} {y:+.2f} {z:+.2f}"
            axis.set_title(title, fontsize=_SMALL)
    return png_bytes(figure, 100)


def _write(
    figure: Figure,
    x: float,
    y: float,
    words: str,
    height: int,
    *,
    ha: str = "center",
    rotation: float = 0,
) -> None:
    """Write text centred at (x, y) in pixels from the bottom left."""
    from matplotlib.transforms import IdentityTransform

    size, in_pixels = height / (_MAPS_DPI / 72), IdentityTransform()
    style: dict[str, Any] = {"size": size, "ha": ha, "va": "center", "rotation": rotation}
    figure.text(x, y, words, transform=in_pixels, parse_math=False, **style)


def _text_height(width: int, lines: Sequence[str], *, most: int = 36) -> int:
    """Return a text height in pixels for which each line fits into the width.

    Short lines do not fill the width.
    """
    longest = max(18, *(len(line) for line in lines))
    # characters are 0.62 of their height wide
    return min(most, max(10, int(width / (0.62 * longest))))


def _scale(height: int, width: int, columns: int) -> float:
    """Return the scale factor, which is an integer or less than 1."""
    # The columns without gaps are at most 3600 pixels wide, and the picture less than 4000. A map
    # has at most 1200 rows.
    most = min(3600 / columns / width, 1200 / height)
    # Small maps are enlarged as long as their longer side stays within 240 pixels.
    return most if most < 1 else max(1, min(int(most), 240 // max(height, width)))


def _resize(picture: Picture, scale: float) -> Picture:
    if scale >= 1:
        return picture.repeat(int(scale), axis=0).repeat(int(scale), axis=1)
    import cv2

    height, width = (max(1, int(side * scale)) for side in picture.shape[:2])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _colour_normals(normals: Floats, known: Bools) -> Picture:
    """Return the colours (n + 1) / 2 of normals (H, W, 3), white where `known` is false.

    Unknown normals may be NaN.
    """
    colours = encode_picture(np.where(known[..., None], normals, 0), known, bits=8).astype(np.uint8)
    colours[~known] = 255
    return colours
