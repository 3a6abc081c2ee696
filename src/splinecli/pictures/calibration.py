"""The picture that shows whether a calibration is right: each ball with its outline, highlight and light direction."""

import cv2
import numpy as np

from splinecli.calibration.balls import BallCalibration
from splinecli.capture.formats.images import read_image
from splinecli.pictures.png import Picture

TILE = 200  # width and height of one ball in the picture, in pixels
_MARGIN = 1.15  # half of a tile's width, in radii of the ball
_CAPTION = 22  # height of the caption below each tile
_COLUMNS = 6
_BRIGHTENING = 0.4  # exponent; makes the outline of a dark ball visible
_GREEN, _RED, _GRAY = (90, 200, 90), (255, 60, 60), (230, 230, 230)


def calibration_picture(balls: tuple[BallCalibration, ...]) -> Picture:
    """Return a picture (H, W, 3) of all images of all balls, in rows of up to six images.

    The green circle is the outline and the red one the highlight. The red line from the centre to the highlight points
    towards the lamp. The caption has the number of the image, from 1, and the light direction x, y, z.
    """
    columns = min(_COLUMNS, max(len(ball.directions) for ball in balls))
    rows = []
    for ball in balls:
        tiles = [_tile(ball, number) for number in range(len(ball.directions))]
        empty = np.zeros_like(tiles[0])
        for start in range(0, len(tiles), columns):
            row = tiles[start : start + columns]
            rows.append(np.hstack(row + [empty] * (columns - len(row))))
    return np.vstack(rows)


def _tile(ball: BallCalibration, number: int) -> Picture:
    path, circle, highlight = ball.files.images[number], ball.circle, ball.highlights[number]
    values = read_image(path).mean(axis=2)
    reach = _MARGIN * circle.radius
    scale = TILE / (2 * reach)
    # The transformation from the tile to the image; pixel centres are at whole numbers in both.
    shift = 0.5 / scale - 0.5
    to_image = np.array([[1 / scale, 0, circle.x - reach + shift], [0, 1 / scale, circle.y - reach + shift]])
    gray = cv2.warpAffine(values, to_image, (TILE, TILE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    gray = (255 * (gray / max(float(gray.max()), 1e-9)) ** _BRIGHTENING).astype(np.uint8)
    tile = cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)

    def place(x: float, y: float) -> tuple[int, int]:
        return round((x - circle.x + reach) * scale), round((y - circle.y + reach) * scale)

    centre, mark = place(circle.x, circle.y), place(highlight.x, highlight.y)
    cv2.circle(tile, centre, round(circle.radius * scale), _GREEN, 1, cv2.LINE_AA)
    cv2.line(tile, centre, mark, _RED, 1, cv2.LINE_AA)
    cv2.circle(tile, mark, 6, _RED, 1, cv2.LINE_AA)
    caption = np.zeros((_CAPTION, TILE, 3), np.uint8)
    x, y, z = ball.directions[number]
    text = f"{number + 1}:  {x:+.2f} {y:+.2f} {z:+.2f}"
    cv2.putText(caption, text, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _GRAY, 1, cv2.LINE_AA)
    return np.vstack((tile, caption)).astype(np.uint8)
