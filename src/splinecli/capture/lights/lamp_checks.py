"""Checks of near lamps: whether they can be where their positions say, and whether they may count as distant."""

from pathlib import Path

import numpy as np

from splinecli.capture.lights.array_files import SUFFIXES as ARRAY_SUFFIXES
from splinecli.capture.lights.light_rows import read_light_rows
from splinecli.capture.lights.named_lights import SUFFIXES as NAMED_SUFFIXES
from splinecli.capture.lights.near_lamps import NearLamps
from splinecli.capture_warnings import LAMP_DISTANCE, NEAR_LAMPS, CaptureWarning
from splinecli.errors import InputError
from splinecli.maths import Bools
from splinecli.system.files import is_substitution

NEAR_DEG = 2.0  # the change of a light direction across the object above which distant lights carry a warning

INSIDE = 0.5
"""A lamp is refused if its distance from the middle of the object is below this share of the smaller of the object's
width and height: it would be inside the object, or hide it from the camera."""

CLOSE, FAR = 1.0, 300.0
"""Distances, in the larger of the object's width and height, that carry a warning: below the first, and above the
second. A position in metres instead of millimetres changes the distance a thousandfold."""

_SHORTEST_POSITION, _UNEQUAL_LENGTHS = 3.0, 1.02
"""Vectors of a file of directions are probably positions above this length, if the longest is so much longer."""

UNIT_HINT = (
    "Give all lengths in one unit, such as millimetres: the lamps' positions or distance, and the pixel size or object"
    " width"
)


def check_distances(lamps: NearLamps, mask: Bools, positions: Path | None) -> list[CaptureWarning]:
    """Warn of lamps that are hardly possible over an object with this mask (H, W), from a file of positions, if any.

    Raises InputError where a lamp would be inside the object, or in front of it.
    """
    sizes, middle = lamps.extent(mask)
    distances = np.linalg.norm(lamps.positions - middle, axis=1)
    nearest = int(distances.argmin())
    text = f"lamp {nearest + 1} is {distances[nearest]:.3g} from the middle of the object, which is {sizes[0]:.3g} wide"
    if distances[nearest] < INSIDE * min(sizes):
        raise InputError(f"{text}: it would be inside the object", path=positions, hint=UNIT_HINT)
    if distances[nearest] < CLOSE * max(sizes):
        return [CaptureWarning(LAMP_DISTANCE, f"A lamp is very near: {text}. {UNIT_HINT}.")]
    if distances[nearest] > FAR * max(sizes):
        return [CaptureWarning(LAMP_DISTANCE, f"The lamps are so far that they are distant: {text}. {UNIT_HINT}.")]
    return []


def distant_lights(positions: Path | None, lamps: NearLamps | None, mask: Bools) -> list[CaptureWarning]:
    """Warn that lights count as distant over a mask (H, W), although a file has their positions.

    The lamps of the file are None where their scale is unknown.
    """
    name = "the lamps' positions" if positions is None else positions.name
    if lamps is None:
        text = f"{name} is not used, because nothing tells the size of a pixel. Give --pixel-size or --object-width."
        return [CaptureWarning(NEAR_LAMPS, text)]
    angle_deg = lamps.angles_across_deg(mask).max()
    if angle_deg <= NEAR_DEG:
        return []
    text = (
        f"The lamps are near: by {name}, a light direction changes by up to {angle_deg:.0f} degrees between the middle"
        " and the edge of the object, but the lights count as distant. Use --light-positions instead of --lights."
    )
    return [CaptureWarning(NEAR_LAMPS, text)]


def positions_as_directions(path: Path) -> list[CaptureWarning]:
    """Warn of a text file of light directions whose vectors have lengths as positions of lamps have."""
    if path.suffix.lower() in (*NAMED_SUFFIXES, *ARRAY_SUFFIXES) or is_substitution(path):
        return []
    try:
        vectors = read_light_rows(path, expected="x y z", n_numbers=3).as_array()
    except InputError:
        return []  # a file of angles
    vectors = vectors.T if vectors.shape[1] != 3 and vectors.shape[0] == 3 else vectors[:, -3:]
    lengths = np.hypot.reduce(vectors, axis=1)
    if len(lengths) < 3 or lengths.min() < _SHORTEST_POSITION or lengths.max() < _UNEQUAL_LENGTHS * lengths.min():
        return []
    text = (
        f"The vectors of {path.name} have lengths from {lengths.min():.4g} to {lengths.max():.4g}, as positions of"
        " lamps have, but count as directions. If they are positions, use --light-positions."
    )
    return [CaptureWarning(NEAR_LAMPS, text)]
