"""Read a capture for its trials, in this process or in another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureSource, open_capture
from splinecli.capture.capture_warnings import GROUND_TRUTH_UPSIDE_DOWN
from splinecli.capture.lights.draws import PIXELS_STREAM
from splinecli.capture.sample import sample_observations
from splinecli.diagnosis.explanations import check_ground_truth
from splinecli.errors import InputError
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.trial_capture import TrialSource

OnImage = Callable[[int, int], object]
"""Called with the number of images read so far and their total."""

DAMAGED_IMAGES = {"bearPNG": 20}
"""The first 20 images of DiLiGenT's Bear are corrupted, as users of the benchmark reported."""


@dataclass(frozen=True)
class CaptureReading:
    """What the trials of a capture need of it.

    Args:
        folder: the capture's folder as it was given. Other processes open it again.
        name: name of the capture in the tables.
        protocols: those that can score it. All protocols of an evaluation score the same pixels.
        lights: those of all trials, in rising order.
        whole: whether all pixels are needed: a method sees neighbours, or lights are refined or found.
    """

    folder: Path
    name: str
    protocols: tuple[Protocol, ...]
    lights: tuple[int, ...]
    whole: bool

    def read(self, source: CaptureSource, on_image: OnImage | None = None) -> tuple[TrialSource, list[tuple[str, ...]]]:
        """Return the capture under all its lights, and the notes on it, by protocol. Raises InputError, UsageError."""
        n_read = 0

        def count() -> None:
            nonlocal n_read
            n_read += 1
            if on_image is not None:
                on_image(n_read, len(self.lights))

        try:
            stored = source.read_stored(self.lights, count)
        except OSError as error:
            raise _as_input_error(error, self.folder) from error
        first = self.protocols[0]
        rows = scored_rows(stored.capture, max_pixels=first.max_pixels, seed=first.seed)
        as_stored = all(protocol.as_stored for protocol in self.protocols)
        notes = [_notes(stored.capture, self.name, protocol) for protocol in self.protocols]
        return TrialSource.with_pixels(stored, rows, as_stored=as_stored, whole=self.whole), notes


def open_to_score(folder: Path, protocol: Protocol) -> CaptureSource:
    """Open a capture under a protocol. Raises InputError, UsageError."""
    try:
        return open_capture(folder, white_level=protocol.white_level)
    except OSError as error:
        raise _as_input_error(error, folder) from error


def _as_input_error(error: OSError, folder: Path) -> InputError:
    return InputError(f"cannot be read ({error.strerror or error})", path=error.filename or folder)


def _notes(capture: Capture, name: str, protocol: Protocol) -> tuple[str, ...]:
    """Return sentences about what is special about a capture and how the evaluation treated it."""
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


def scored_rows(capture: Capture, *, max_pixels: int | None = None, seed: int = 0) -> NDArray[np.intp]:
    """Return the rows of the observations that have ground truth, in rising order.

    With `max_pixels`, the seed chooses at most that many of them: the same pixels for every method and trial. A method
    that sees neighbours estimates all pixels, and only these are scored.

    Raises:
        InputError: the capture has no ground truth.
    """
    if capture.ground_truth is None:
        raise InputError(f"{capture.name}: the capture has no ground truth")
    rows = np.flatnonzero(np.any(capture.ground_truth[capture.mask], axis=1))
    if max_pixels is not None and len(rows) > max_pixels:
        generator = np.random.default_rng([PIXELS_STREAM, seed, len(rows)])
        rows = np.sort(generator.permutation(rows)[:max_pixels])
    return rows
