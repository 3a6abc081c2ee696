"""The colours of lamps, where they differ from image to image.

A matte pixel has a colour of its own, and each lamp changes it by the same factors everywhere: R_pf = e_f^R a_p^R s_pf,
and so on. Averaged over the channels, a red pixel then looks darker under a green lamp, as if it were turned away.
The factors are found from the medians of the colours' changes, and each channel is divided by its own.
"""

import numpy as np

from splinecli import capture_warnings as codes
from splinecli.capture_warnings import CaptureWarning
from splinecli.maths import Doubles, Floats

SAMPLE = 1500  # pixels of which the colours are compared

LEAST_CHANGE, MOST_SCATTER = 0.15, 0.4
"""Smallest change of a channel against the others, as a logarithm, that is corrected, and the largest share of it by
which the pixels may differ. White LEDs differ by 0.05. Light from other parts of the object varies over the pixels."""

LEAST_CHANNEL = 0.1  # of a lamp's mean colour; a fainter channel is mostly noise
LEAST_VARIETY, STRIPED_VARIETY = 0.05, 0.5
"""Standard deviation over the pixels of the logarithm of a channel against the others: below the first, the object has
one colour; at the second, it has stripes of strong colours."""

UNKNOWN_ERROR_DEG = 15.0  # of striped objects under lamps of pure colours, whose colours cannot be divided out

_DARK_SHARE = 0.15  # of the brightest hundredth of the sample, in every image
_MIN_PIXELS = 50
_LEAST_SHARE = 1e-3


def lamp_colours(colours: Floats) -> tuple[Doubles | None, list[CaptureWarning]]:
    """Return the colours (F, 3) of lamps, by which channels are to be divided, or None for equal ones; and warnings.

    Args:
        colours: (F, p, 3), linear RGB of some pixels in all images, divided by the intensities that are known.
    """
    sums = colours.sum(axis=2, dtype=np.float64)
    lit = (sums > _DARK_SHARE * np.quantile(sums, 0.99)).all(axis=0)
    if np.count_nonzero(lit) < _MIN_PIXELS:
        lit = sums.min(axis=0) >= np.quantile(sums.min(axis=0), 0.7)  # some of the pixels are in shadow everywhere
    if np.count_nonzero(lit) < _MIN_PIXELS:
        return None, []
    shares = colours[:, lit] / np.maximum(sums[:, lit, None], 1e-9)
    logs = np.log(np.maximum(shares, _LEAST_SHARE))
    logs -= logs.mean(axis=2, keepdims=True)
    changes = logs - np.median(logs, axis=0)
    common = np.median(changes, axis=1)
    image, channel = np.unravel_index(np.abs(common).argmax(), common.shape)
    most = float(abs(common[image, channel]))
    scatter = float(np.median(np.abs(changes[image, :, channel] - common[image, channel])))
    # An object of one colour only looks brighter under one lamp and darker under another.
    variety = float(np.median(logs.std(axis=1).max(axis=1)))
    if most < LEAST_CHANGE or scatter > MOST_SCATTER * most or variety < LEAST_VARIETY:
        return None, []
    found = np.exp(common)
    found /= found.mean(axis=1, keepdims=True)
    said = "The colour of the light varies from image to image"
    if found.min() < LEAST_CHANNEL:
        text = f"{said}, and some lamps lack a colour, so it cannot be divided out. The normals of coloured objects are"
        text += " wrong. Use white lamps, or give RGB intensities with --intensities FILE."
        error_deg = UNKNOWN_ERROR_DEG * min(1.0, variety / STRIPED_VARIETY)
        return None, [CaptureWarning(codes.LIGHT_COLOURS, text, error_deg)]
    text = f"{said}: it was estimated from the images and divided out. Use --intensities FILE if you have measured it."
    return found, [CaptureWarning(codes.ESTIMATED_COLOURS, text)]
