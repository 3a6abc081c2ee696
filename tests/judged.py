"""The checks of captures that were made without files."""

import numpy as np

from splinecli.capture.arrays import ArraySource
from splinecli.judge.checks import check_capture


def judgement_of(capture, *, intensities=None):
    """Return what the checks find in a capture, whose light intensities (F,) or (F, 3) were given
    or are unknown.
    """
    known = intensities is not None
    given = (
        np.ones(capture.n_lights) if intensities is None else np.asarray(intensities, np.float64)
    )
    source = ArraySource(
        images=[],
        mask=capture.mask,
        light_directions=capture.light_directions,
        light_intensities=np.broadcast_to(
            given[:, None] if given.ndim == 1 else given, (capture.n_lights, 3)
        ),
        lamps=capture.lamps,
        intensities_known=known,
        intensities_measured=known,
    )
    return check_capture(source, capture)


def warnings_of(capture, *, intensities=None):
    """Return the warnings of judgement_of."""
    return judgement_of(capture, intensities=intensities).warnings
