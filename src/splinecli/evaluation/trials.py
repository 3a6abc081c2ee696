"""The trials of an evaluation, a store that saves their scores as they are computed, and the
capture data that they share.
"""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from msgspec import MsgspecError, Struct, structs
from msgspec import json as msgspec_json
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureOptions, CaptureSource, open_capture
from splinecli.capture.record import in_one_plane
from splinecli.capture.sample import sample_observations
from splinecli.errors import InputError
from splinecli.estimate.inference import estimate_normals, find_surface
from splinecli.estimate.methods import Estimator
from splinecli.evaluation.protocol import NOISE_STREAM, PIXELS_STREAM, Protocol
from splinecli.judge.odd_images import check_ground_truth
from splinecli.lights.draws import Draw
from splinecli.lights.light_fit import divide_by_fitted, find_factors
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.recipe.steps import begin, follow
from splinecli.recipe.work import RecipeOptions, Work
from splinecli.records.capture_warnings import GROUND_TRUTH_UPSIDE_DOWN
from splinecli.system.files import as_splinecli_error, refusals_as_output_errors, write_text
from splinecli.system.progress import Progress, ignore
from splinecli.system.publishing import is_plain


@dataclass(frozen=True)
class Trial:
    """One method on one capture under one draw of lights, with everything that affects its
    score.
    """

    capture: str  # name of the capture in the tables
    method: str
    number: int  # number of the trial, from 0
    lights: Draw
    protocol: Protocol
    made_of: str  # digest of the capture's files and of the method's settings

    @property
    def record(self) -> dict[str, Any]:
        """The trial as JSON values."""
        names = (
            "capture",
            "method",
            "number",
            "lights",
            "light_noise_deg",
            "seed",
            "max_pixels",
            "as_stored",
        )
        values = vars(self) | vars(self.protocol)
        return {
            name: values[name] for name in (*names, "made_of", "light_error_deg", "finds_lights")
        }

    @property
    def key(self) -> str:
        """SHA-256 of everything that affects the score.

        The noise depends on seed and number, and the pixels on the seed.
        """
        values = self.record
        del values["capture"]  # only a name; made_of depends on the files
        if self.protocol.light_error_deg is None:
            del values["light_error_deg"]  # so that earlier trials stay valid
        if not self.protocol.finds_lights:
            del values["finds_lights"]  # for the same reason
        if self.protocol.light_noise_deg == 0:
            del values["number"]
            if self.protocol.max_pixels is None:
                del values["seed"]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


class Score(Struct, frozen=True):
    """The score of a trial."""

    mae_deg: float  # mean angular error over the scored pixels
    seconds: float  # time spent on estimating their normals
    estimated_intensities: bool  # whether the light intensities were estimated from the images
    # mean error of light directions that were estimated from the images
    found_light_error_deg: float | None = None


class _Line(Score, frozen=True, kw_only=True):
    """The part of a stored line that is read again. The rest describes the trial to readers."""

    key: str


class TrialStore:
    """Scores by trial, in memory and, with a path, in a JSON Lines file.

    The file is created for the first score. Lines that cannot be read, for example because they
    were truncated, are dropped. A link is replaced, not followed. `fresh` deletes the scores of an
    earlier evaluation. Raises OutputError if the file cannot be read or written.
    """

    def __init__(self, path: Path | None = None, *, fresh: bool = False) -> None:
        self._path = path
        self._lock = Lock()
        self._scores: dict[str, Score] = {}
        if path is None:
            return
        with refusals_as_output_errors(path):
            kept = []
            if is_plain(path) and not fresh:
                with path.open(encoding="utf-8", errors="replace") as file:
                    while line := file.readline(1 << 16):  # longer lines are read in parts
                        with suppress(MsgspecError, RecursionError):
                            read = msgspec_json.decode(line, type=_Line)
                            kept.append(line.rstrip("\n") + "\n")
                            self._scores[read.key] = read
            # Write a new file, because appending would also change any hard link to the old one.
            if os.path.lexists(path):
                write_text(path, "".join(kept))

    def find(self, trial: Trial) -> Score | None:
        """Return the score of a trial; None if it is not stored."""
        return self._scores.get(trial.key)

    def add(self, trial: Trial, score: Score) -> None:
        """Store a score. This may be called from any thread. Raises OutputError."""
        with self._lock:
            self._scores[trial.key] = score
            if self._path is None:
                return
            line = json.dumps({**trial.record, **structs.asdict(score), "key": trial.key})
            with (
                refusals_as_output_errors(self._path),
                self._path.open("a", encoding="utf-8") as file,
            ):
                file.write(line + "\n")


# Called with the number of images read so far and the total number
OnImage = Callable[[int, int], object]
Notes = list[tuple[str, ...]]  # sentences about a capture, for each protocol
# The first 20 images of DiLiGenT's Bear are corrupted, as users of the benchmark reported.
DAMAGED_IMAGES = {"bearPNG": 20}


@dataclass(frozen=True)
class TrialSource:
    """A capture that was read once, from which each trial selects its lights.

    Every draw is restored separately: saturated observations are restored from the other lights of
    the draw, as if `infer` read only these lights. `rows` are the rows of the observations to
    score; None for all rows.
    """

    stored: Work
    rows: NDArray[np.integer] | None = None

    def see(self, trial: Trial, *, whole: bool = False) -> Capture:
        """Return the capture under a trial's lights, which are disturbed, refined or estimated as
        required.

        It contains the scored pixels or, with `whole`, all pixels. As in `infer`, lights are
        refined or estimated from all pixels.
        """
        protocol, pixels = trial.protocol, None if whole else self.rows
        work = self.stored.choose_images(self.places(trial.lights))
        if protocol.light_noise_deg:
            work = replace(work, capture=_with_noise(work.made, trial))
        work = replace(work, options=protocol.recipe)
        # The intensities are estimated from all pixels, before the scored pixels are chosen.
        work = follow(work, "lights", until="saturation")
        needs_all = work.options.finds_lights or work.options.refine_lights
        if pixels is not None and not needs_all and work.made.lamps is None:
            work, pixels = work.choose_pixels(pixels), None
        capture = follow(work, "saturation").made
        if pixels is None:
            return capture
        # Near lamps require the surface, which is computed from all pixels together.
        return find_surface(capture).choose_pixels(pixels)

    def places(self, lights: Sequence[int]) -> list[int]:
        """Return the positions of lights among the lights that were read."""
        place = {light: place for place, light in enumerate(self.stored.made.light_indices)}
        return [place[light] for light in lights]


class SharedDraw:
    """The capture shared by the methods of one draw, computed when a method first needs it."""

    def __init__(self, source: TrialSource) -> None:
        self._source = source
        self._lock = Lock()
        self._captures: dict[bool, Capture] = {}

    def score(
        self,
        trial: Trial,
        estimator: Estimator,
        begin: Callable[[int], Progress] = lambda n_pixels: ignore,
    ) -> Score:
        """Return the score of a trial of the draw. This may be called from any thread.

        `begin` is called with the number of pixels before they are estimated, and returns a
        function that counts finished pixels. Raises SplinecliError if the method returns normals
        that are not unit vectors.
        """
        source, whole = self._source, estimator.needs_capture
        with self._lock:
            if whole not in self._captures:
                self._captures[whole] = source.see(trial, whole=whole)
        capture = self._captures[whole]
        estimate = estimate_normals(capture, estimator, progress=begin(capture.n_pixels))
        # otherwise there would be no trials
        assert estimate.errors is not None and estimate.error_map_deg is not None
        mae_deg = estimate.errors.mean
        if source.rows is not None and capture.n_pixels != len(source.rows):
            mae_deg = float(estimate.error_map_deg[capture.mask][source.rows].mean())
        light_error_deg = None
        if capture.light_errors_deg is not None:
            true = source.stored.made.light_directions[source.places(trial.lights)]
            light_error_deg = float(angle_between_deg(capture.light_directions, true).mean())
        return Score(
            mae_deg, estimate.seconds, capture.estimated_intensities is not None, light_error_deg
        )


def _with_noise(capture: Capture, trial: Trial) -> Capture:
    """Return the capture with the trial's noise on its lights. Near lamps keep their distances."""
    generator = np.random.default_rng([NOISE_STREAM, trial.protocol.seed, trial.number])
    # Few lights with large noise may become coplanar, so the noise is drawn again.
    for _ in range(100):
        directions = tilt_lights(
            capture.light_directions, trial.protocol.light_noise_deg, generator
        )
        if not in_one_plane(directions):
            break
    lamps = None if capture.lamps is None else capture.lamps.turned(directions)
    return replace(capture, light_directions=directions, lamps=lamps)


def tilt_lights(
    light_directions: NDArray[np.float64], sigma_deg: float, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Return unit light directions (F, 3), each rotated by an angle from N(0, sigma_deg).

    The rotations are in random directions, and the root mean square of the angles is sigma_deg. A
    light that would fall below the horizon (z <= 0) is rotated the opposite way and stays above it,
    so that all directions are valid for a capture.
    """
    n_lights = len(light_directions)
    angle = np.radians(generator.normal(0.0, sigma_deg, n_lights).clip(-89.0, 89.0))
    # Removing the component along the light from a Gaussian vector makes every perpendicular
    # direction equally likely.
    across = generator.normal(size=(n_lights, 3))
    along = np.einsum("fi,fi->f", across, light_directions)
    across = unit(across - along[:, None] * light_directions)
    sunk = np.cos(angle) * light_directions[:, 2] + np.sin(angle) * across[:, 2] <= 0
    angle = np.where(sunk, -angle, angle)[:, None]
    return unit(np.cos(angle) * light_directions + np.sin(angle) * across)


@dataclass(frozen=True)
class CaptureReading:
    """The parts of a capture that its trials need."""

    folder: Path  # the capture's folder as given, which other processes open again
    name: str
    # the protocols that can score it, which all score the same pixels
    protocols: tuple[Protocol, ...]
    lights: tuple[int, ...]  # the lights used by any trial, in ascending order
    # whether all pixels are needed: a method uses them, or lights are refined or estimated
    whole: bool

    def read(
        self, source: CaptureSource, on_image: OnImage = lambda *_: None
    ) -> tuple[TrialSource, Notes]:
        """Return the capture under all lights, and notes on it by protocol.

        Raises InputError or UsageError.
        """
        numbers, n_images = count(1), len(self.lights)
        as_stored = all(protocol.as_stored for protocol in self.protocols)
        try:
            stored = follow(
                begin(source, self.lights, RecipeOptions(as_stored=as_stored)),
                until="lights",
                advance=lambda *_: on_image(min(next(numbers), n_images), n_images),
            )
        except OSError as error:
            raise as_splinecli_error(error, self.folder) from error
        first, capture = self.protocols[0], stored.made
        pixels = scored_rows(capture, max_pixels=first.max_pixels, seed=first.seed)
        if len(pixels) == capture.n_pixels:
            trials = TrialSource(stored)
        elif self.whole or capture.lamps is not None or not (as_stored or source.intensities_known):
            # Unknown intensities are estimated from all pixels, as in `infer`, and near lamps
            # require the whole surface.
            trials = TrialSource(stored, pixels)
        else:
            trials = TrialSource(stored.choose_pixels(pixels))
        known = source.intensities_measured
        notes = [_notes(capture, self.name, protocol, known) for protocol in self.protocols]
        return trials, notes


def open_to_score(folder: Path, protocol: Protocol) -> CaptureSource:
    """Open a capture under a protocol. Raises InputError or UsageError."""
    try:
        return open_capture(folder, CaptureOptions(white_level=protocol.white_level))
    except OSError as error:
        raise as_splinecli_error(error, folder) from error


def _notes(
    capture: Capture, name: str, protocol: Protocol, intensities_measured: bool
) -> tuple[str, ...]:
    """Return sentences about peculiarities of a capture and how they were treated."""
    notes = []
    skipped, damaged = protocol.skipped_lights(name), DAMAGED_IMAGES.get(name, 0)
    if skipped:
        notes.append(f"{name}: the first {skipped} images were left out.")
    elif damaged:
        notes.append(
            f"{name}: the first {damaged} images are used although they are known to be damaged."
            f" To leave them out, add --skip-first {name}={damaged}."
        )
    notes += [
        f"{name}: {warning}"
        for warning in capture.warnings
        if warning.kind == GROUND_TRUTH_UPSIDE_DOWN
    ]
    if capture.ground_truth is not None:
        sample = sample_observations(capture.observations, capture.mask)
        if not intensities_measured:
            factors = find_factors(sample.observations, intensities_known=False)
            values = divide_by_fitted(sample.observations, capture.light_directions, factors)
            sample = replace(sample, observations=values)
        wrong = check_ground_truth(sample, capture.light_directions, capture.ground_truth)
        notes += [f"{name}: {warning}" for warning in wrong]
        without = capture.n_pixels - int(
            np.count_nonzero(capture.ground_truth[capture.mask].any(axis=1))
        )
        if without:
            notes.append(
                f"{name}: {without} of {capture.n_pixels} pixels in the mask have no ground-truth"
                " normal and are not scored."
            )
    return tuple(notes)


def scored_rows(
    capture: Capture, *, max_pixels: int | None = None, seed: int = 0
) -> NDArray[np.intp]:
    """Return the rows of the observations that have ground truth, in ascending order.

    With `max_pixels`, at most that many are chosen by the seed, the same for every method and
    trial. A method that uses neighbouring pixels estimates all pixels, but only these are scored.
    Raises InputError without ground truth.
    """
    if capture.ground_truth is None:
        raise InputError(f"{capture.name}: the capture has no ground truth")
    pixels = np.flatnonzero(np.any(capture.ground_truth[capture.mask], axis=1))
    if max_pixels is not None and len(pixels) > max_pixels:
        generator = np.random.default_rng([PIXELS_STREAM, seed, len(pixels)])
        pixels = np.sort(generator.permutation(pixels)[:max_pixels])
    return pixels
