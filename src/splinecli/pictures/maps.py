"""Pictures of the maps of one capture: albedo, confidence, a preview of the surface, and angular errors."""

import numpy as np

from splinecli.maths import Bools, Floats, Singles
from splinecli.maths.normals import unit
from splinecli.maths.transfer import encode_srgb
from splinecli.pictures.png import Picture

PREVIEW_LIGHT = (-0.72, 0.48, 0.5)  # direction: low, from the upper left, which shows relief best
WHITE_QUANTILE = 0.99  # of the largest channel: this albedo is white in a picture
CURVATURE_SCALE, RELIEF_SCALE = 0.05, 1.0  # by default white in a picture: mean curvature in 1/pixel, relief in pixels

TOP_DEG = 30.0  # of the colour scale; larger errors have the last colour: the scale serves the small errors

TICKS = {TOP_DEG * third / 3: f"{TOP_DEG * third / 3:g}" + "+" * (third == 3) for third in range(4)}
TITLE = "angular error (deg)"

_SMALLEST_HEIGHT = 256  # pixels: room for the colour bar and its text
_LARGEST_ENLARGED = 1024  # pixels: a small map is not enlarged beyond this width
_TEXT_SIZE = 0.45  # OpenCV's font scale in a picture of _USUAL_HEIGHT; capitals are 10 pixels high
_USUAL_HEIGHT = 400
_BACKGROUND, _INK = 255, 0


def albedo_picture(albedo: Singles, mask: Bools) -> Picture:
    """Return a linear albedo map (H, W, 3) as an sRGB picture, in which the brightest 1 % of the pixels are white.

    The scale depends on the pixels of the mask (H, W) alone, which is not empty.
    """
    white = max(float(np.quantile(albedo[mask].max(axis=1), WHITE_QUANTILE)), 1e-12)
    return encode_srgb(albedo / white)


def confidence_picture(confidence_map: Singles) -> Picture:
    """Return a map of probabilities (H, W) as a gray picture (H, W): 0 is black, 1 is white."""
    return np.rint(255 * confidence_map).astype(np.uint8)


def preview_picture(normal_map: Singles, mask: Bools) -> Picture:
    """Return an sRGB picture (H, W, 3) of the surface, matte white under PREVIEW_LIGHT.

    It is black outside the mask (H, W).
    """
    shading = (normal_map @ unit(np.array(PREVIEW_LIGHT, np.float32))) * mask
    return np.repeat(encode_srgb(shading)[..., None], 3, axis=2)


def signed_picture(values: Singles, scale: float) -> Picture:
    """Return values (H, W) as a gray picture (H, W): 0 and NaN are gray, -scale is black, scale is white."""
    share = np.nan_to_num(values / scale).clip(-1, 1)
    return np.asarray(np.rint(127.5 + 127.5 * share), np.uint8)


def error_map_picture(error_map_deg: Floats) -> Picture:
    """Return an error map (H, W) in degrees as an RGB picture (H', W', 3) with a colour bar at its right.

    A map of fewer than 256 rows is enlarged by a whole factor while its width stays within 1024 pixels, then padded to
    256 rows.
    """
    picture = colour_errors(error_map_deg)
    height, width = picture.shape[:2]
    factor = max(1, min(-(-_SMALLEST_HEIGHT // height), _LARGEST_ENLARGED // width))
    picture = picture.repeat(factor, axis=0).repeat(factor, axis=1)
    missing = max(0, _SMALLEST_HEIGHT - len(picture))
    picture = np.pad(picture, ((missing // 2, missing - missing // 2), (0, 0), (0, 0)), constant_values=_BACKGROUND)
    return np.hstack([picture, _colour_bar(len(picture))])


def colour_errors(error_map_deg: Floats) -> Picture:
    """Return the colours (H, W, 3) of errors (H, W) in degrees: viridis, from violet for 0 to yellow; white for NaN."""
    import cv2

    known = np.isfinite(error_map_deg)
    shares = np.where(known, error_map_deg, 0) / TOP_DEG
    levels = np.rint(shares.clip(0, 1) * 255).astype(np.uint8)
    picture: Picture = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    picture[~known] = _BACKGROUND
    return picture


def bounding_box(mask: Bools) -> tuple[slice, slice]:
    """Return the rows and the columns of the smallest box that has all of a mask (H, W)."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _colour_bar(height: int) -> Picture:
    """Return the colour bar with ticks, labels and a vertical title: (height, W, 3), W as large as needed."""
    scale = max(1.0, height / _USUAL_HEIGHT)
    texts = [_text(label, scale) for label in TICKS.values()]
    title = np.rot90(_text(TITLE, scale))
    gap, bar_width, line = round(8 * scale), round(18 * scale), max(1, round(scale))
    margin = texts[0].shape[0]  # keeps the outermost labels whole
    bar_height = height - 2 * margin

    label_x = 3 * gap + bar_width
    title_x = label_x + max(text.shape[1] for text in texts) + gap
    panel = np.full((height, title_x + title.shape[1] + gap, 3), _BACKGROUND, np.uint8)
    column = np.linspace(TOP_DEG, 0, bar_height)[:, None].repeat(bar_width, axis=1)
    panel[margin : margin + bar_height, 2 * gap : 2 * gap + bar_width] = colour_errors(column)
    for value, text in zip(TICKS, texts, strict=True):
        y = margin + round((1 - value / TOP_DEG) * (bar_height - 1))
        top = min(y - line // 2, margin + bar_height - line)
        panel[top : top + line, 2 * gap + bar_width : label_x - gap // 2] = _INK
        _paste(panel, text, y - text.shape[0] // 2, label_x)
    _paste(panel, title, (height - title.shape[0]) // 2, title_x)
    return panel


def _text(text: str, scale: float) -> Picture:
    """Return a line of text (h, w), black on white, without margins."""
    import cv2

    font, size, thickness = cv2.FONT_HERSHEY_SIMPLEX, _TEXT_SIZE * scale, max(1, round(scale))
    (width, height), below = cv2.getTextSize(text, font, size, thickness)
    canvas = np.full((height + below + 2 * thickness, width + 2 * thickness), _BACKGROUND, np.uint8)
    cv2.putText(canvas, text, (thickness, height + thickness), font, size, _INK, thickness, cv2.LINE_AA)
    # OpenCV 4 and 5 have different fonts and report different heights, so crop to the drawn pixels.
    return canvas[bounding_box(canvas < _BACKGROUND)]


def _paste(panel: Picture, gray: Picture, y: int, x: int) -> None:
    height, width = gray.shape
    panel[y : y + height, x : x + width] = gray[..., None]
