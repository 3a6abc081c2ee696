"""Notes on what is special about a capture and how the evaluation treated it."""

from __future__ import annotations

import numpy as np

from splinecli.capture import Capture
from splinecli.capture.capture_warnings import GROUND_TRUTH_UPSIDE_DOWN
from splinecli.capture.sample import sample_observations
from splinecli.diagnosis.ground_truth import check_ground_truth
from splinecli.evaluation.protocol import Protocol

DAMAGED_IMAGES = {"bearPNG": 20}
"""The first 20 images of DiLiGenT's Bear are corrupted, as users of the benchmark reported."""


def capture_notes(capture: Capture, name: str, protocol: Protocol) -> tuple[str, ...]:
    """Return sentences about a capture with all its pixels; none for an ordinary one."""
    notes = []
    skipped, damaged = protocol.skipped_lights(name), DAMAGED_IMAGES.get(name, 0)
    if skipped:
        notes.append(f"{name}: the first {skipped} images are left out.")
    elif damaged:
        notes.append(
            f"{name}: the first {damaged} images are known to be damaged and are used;"
            f" --skip-first {name}={damaged} leaves them out."
        )
    notes += [f"{name}: {warning}" for warning in capture.warnings if warning.code == GROUND_TRUTH_UPSIDE_DOWN]
    if capture.ground_truth is not None:
        sample = sample_observations(capture.observations, capture.mask)
        wrong = check_ground_truth(sample, capture.light_directions, capture.ground_truth)
        notes += [f"{name}: {warning}" for warning in wrong]
        without = capture.n_pixels - int(np.count_nonzero(capture.ground_truth[capture.mask].any(axis=1)))
        if without:
            notes.append(
                f"{name}: {without} of {capture.n_pixels} pixels in the mask have no ground-truth normal"
                " and are not scored."
            )
    return tuple(notes)
