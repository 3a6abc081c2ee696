"""Pictures of maps, of balls of a calibration, and of the scenes of a pixel set, as PNG files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.images import read_image
from splinecli.errors import OutputError
from splinecli.maths import Bools, Floats, Singles
from splinecli.maths.normals import encode_picture, unit
from splinecli.maths.transfer import encode_srgb

if TYPE_CHECKING:
    from splinecli.calibration.balls import BallCalibration
    from splinecli.pixel_sets.store import Entry, PixelSet

Picture = NDArray[np.uint8]  # an RGB picture (H, W, 3) or a gray picture (H, W) of 8 bits


_HEAD = 33  # bytes of the signature and of the header, which is the first chunk of a file


def encode_png(
    picture: NDArray[np.unsignedinteger], texts: Mapping[str, str] | None = None, *, film: bool = False
) -> bytes:
    """Return the PNG file of an RGB picture (H, W, 3) or a gray picture (H, W) of 8 or 16 bits.

    It has texts by keyword, in Latin-1 (PNG specification, tEXt). The values of a film have the primaries and the
    transfer curve of BT.709 (cICP). Raises OutputError if OpenCV cannot encode the picture.
    """
    import cv2

    done, encoded = cv2.imencode(".png", picture if picture.ndim == 2 else picture[..., ::-1])
    if not done:
        raise OutputError("the picture cannot be encoded as PNG")
    file = encoded.tobytes()
    # Neither OpenCV nor Pillow writes both 16-bit colours and texts.
    chunks = [b"tEXt" + f"{keyword}\0{text}".encode("latin-1") for keyword, text in (texts or {}).items()]
    chunks += [b"cICP\x01\x01\x00\x01"] if film else []
    whole = [struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in chunks]
    return file[:_HEAD] + b"".join(whole) + file[_HEAD:]


PREVIEW_LIGHT = (-0.72, 0.48, 0.5)  # direction: low, from the upper left, which shows relief best
WHITE_QUANTILE = 0.99  # of the largest channel: this albedo is white in a picture
CURVATURE_SCALE, RELIEF_SCALE = 0.05, 1.0

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


def confidence_picture(confidence_map: Singles, _: Bools | None = None) -> Picture:
    """Return a map of probabilities (H, W) as a gray picture (H, W): 0 is black, 1 is white."""
    return np.rint(255 * confidence_map).astype(np.uint8)


def preview_picture(normal_map: Singles, mask: Bools) -> Picture:
    """Return an sRGB picture (H, W, 3) of the surface, matte white under PREVIEW_LIGHT.

    It is black outside the mask (H, W).
    """
    shading = (normal_map @ unit(np.array(PREVIEW_LIGHT, np.float32))) * mask
    return np.repeat(encode_srgb(shading)[..., None], 3, axis=2)


def signed_picture(values: Singles, _: Bools, scale: float) -> Picture:
    """Return values (H, W) or the first of (H, W, C) as a gray picture: 0 and NaN gray, -scale black, scale white."""
    first = values if values.ndim == 2 else values[..., 0]
    share = np.nan_to_num(first / scale).clip(-1, 1)
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


BALL_TILE = 200  # width and height of one ball in the picture, in pixels
_MARGIN = 1.15  # half of a tile's width, in radii of the ball
_CAPTION = 22  # height of the caption below each tile
_BRIGHTENING = 0.4  # exponent; makes the outline of a dark ball visible
_GREEN, _RED, _GRAY = (90, 200, 90), (255, 60, 60), (230, 230, 230)


def calibration_picture(balls: tuple[BallCalibration, ...]) -> Picture:
    """Return a picture (H, W, 3) of all images of all balls, in rows of up to six images.

    The green circle is the outline and the red one the highlight. The red line from the centre to the highlight points
    towards the lamp. The caption has the number of the image, from 1, and the light direction x, y, z.
    """
    columns = min(6, max(len(ball.directions) for ball in balls))
    rows = []
    for ball in balls:
        tiles = [_tile(ball, number) for number in range(len(ball.directions))]
        empty = np.zeros_like(tiles[0])
        for start in range(0, len(tiles), columns):
            row = tiles[start : start + columns]
            rows.append(np.hstack(row + [empty] * (columns - len(row))))
    return np.vstack(rows)


def _tile(ball: BallCalibration, number: int) -> Picture:
    import cv2

    path, circle, highlight = ball.files.images[number], ball.circle, ball.highlights[number]
    values = read_image(path).mean(axis=2)
    reach = _MARGIN * circle.radius
    scale = BALL_TILE / (2 * reach)
    # The transformation from the tile to the image; pixel centres are at whole numbers in both.
    shift = 0.5 / scale - 0.5
    to_image = np.array([[1 / scale, 0, circle.x - reach + shift], [0, 1 / scale, circle.y - reach + shift]])
    gray = cv2.warpAffine(values, to_image, (BALL_TILE, BALL_TILE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    gray = (255 * (gray / max(float(gray.max()), 1e-9)) ** _BRIGHTENING).astype(np.uint8)
    tile = cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)

    def place(x: float, y: float) -> tuple[int, int]:
        return round((x - circle.x + reach) * scale), round((y - circle.y + reach) * scale)

    centre, mark = place(circle.x, circle.y), place(highlight.x, highlight.y)
    cv2.circle(tile, centre, round(circle.radius * scale), _GREEN, 1, cv2.LINE_AA)
    cv2.line(tile, centre, mark, _RED, 1, cv2.LINE_AA)
    cv2.circle(tile, mark, 6, _RED, 1, cv2.LINE_AA)
    caption = np.zeros((_CAPTION, BALL_TILE, 3), np.uint8)
    x, y, z = ball.directions[number]
    text = f"{number + 1}:  {x:+.2f} {y:+.2f} {z:+.2f}"
    cv2.putText(caption, text, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _GRAY, 1, cv2.LINE_AA)
    return np.vstack((tile, caption)).astype(np.uint8)


SCENE_TILE = 96  # pixels: large enough to recognise shapes and materials; sixty scenes fit on a screen or two
LARGE_TILE, FEW_SCENES = 160, 12
MOST_SCENES = 120
_LIGHTS = ((0.4, 0.4, 0.82), (-0.75, 0.2, 0.63))


def contact_sheet(pixel_set: PixelSet) -> Picture:
    """Return an RGB picture (H, W, 3) with a strip for each scene, or for an even choice of at most MOST_SCENES."""
    scenes: dict[str, list[Entry]] = {}
    for entry in pixel_set.entries:
        scenes.setdefault(entry.scene, []).append(entry)
    every = -(-len(scenes) // MOST_SCENES)
    tile = LARGE_TILE if len(scenes) <= FEW_SCENES else SCENE_TILE
    with np.errstate(all="ignore"):  # a damaged array may have NaN
        strips = [_strip(pixel_set, entries, tile) for entries in list(scenes.values())[::every]]
    width = max(strip.shape[1] for strip in strips)
    across = max(1, 1900 // width)
    padded = [np.pad(strip, ((2, 2), (2, width - strip.shape[1] + 6), (0, 0))) for strip in strips]
    padded += [np.zeros_like(padded[0])] * (-len(padded) % across)
    rows = [np.hstack(padded[start : start + across]) for start in range(0, len(padded), across)]
    return np.vstack(rows)


def _strip(pixel_set: PixelSet, entries: list[Entry], tile: int) -> Picture:
    first = pixel_set.load(entries[0])
    tiles = [_fit(encode_picture(_on_mask(first.normals, first.mask), np.asarray(first.mask), bits=8), tile)]
    for pixels in map(pixel_set.load, entries):
        for light in _LIGHTS:
            # The image under the closest light, scaled so that its 98th percentile is white.
            closest = int(np.argmax(pixels.light_directions @ np.array(light)))
            values = np.asarray(pixels.observations[:, closest], np.float32)
            exposed = (values / max(float(np.percentile(values, 98)), 1e-6)).clip(0, 1) ** (1 / 2.2)
            gray = np.rint(exposed[:, None] * 255).repeat(3, axis=1)
            tiles.append(_fit(_on_mask(gray, pixels.mask).astype(np.uint8), tile))
    return np.hstack(tiles)


def _on_mask(values: Floats, mask: Bools) -> Floats:
    picture = np.zeros((*mask.shape, values.shape[1]), values.dtype)
    picture[mask] = values
    return picture


def _fit(picture: NDArray[np.unsignedinteger], tile: int) -> Picture:
    import cv2

    scale = tile / max(picture.shape[:2])
    height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
    small = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    top, left = (tile - height) // 2, (tile - width) // 2
    return np.pad(small, ((top, tile - height - top), (left, tile - width - left), (0, 0)))
