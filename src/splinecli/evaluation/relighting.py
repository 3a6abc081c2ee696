"""Compare photographs under lights that a draw leaves out with pictures of the material estimated from the others."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from splinecli.capture import Capture, open_capture
from splinecli.documents import Likeness, RelightingReport
from splinecli.errors import UsageError
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.run import draws_for, read_draws_file
from splinecli.evaluation.trials import Trial, TrialSource
from splinecli.inference import estimate_normals
from splinecli.maths import Float32Array, Floats
from splinecli.methods import Estimator
from splinecli.results.maps import agreeing_lights
from splinecli.results.material import material_of


def relight_first_draw(folder: Path, name: str, estimator: Estimator, protocol: Protocol) -> RelightingReport:
    """Return the relighting of a capture from the protocol's first draw. Raises SplinecliError."""
    source = open_capture(folder, white_level=protocol.white_level)
    read, draws_file = read_draws_file(protocol)
    trial = Trial(name, estimator.name, 0, draws_for(source, name, read, draws_file)[0], read, "")
    lights = range(protocol.skipped_lights(name), source.n_lights)
    stored = source.read_stored(lights, as_stored=protocol.as_stored)
    return relight(TrialSource(stored).see(trial), stored.capture, estimator, name=name)


def relight(given: Capture, whole: Capture, estimator: Estimator, *, name: str) -> RelightingReport:
    """Return how well the material from one choice of lights predicts the photographs under the others.

    Args:
        given: the capture under the lights that are used.
        whole: the same capture under all lights, as stored.
        name: name of the capture in the tables.

    Raises:
        UsageError: the draw uses all lights, or the lamps or the camera are near.
        InputError: too few lights are used.
    """
    from splinecli.materials.maps import lights_that_reach, render_gray

    held = [place for place, light in enumerate(whole.light_indices) if light not in given.light_indices]
    if not held:
        raise UsageError(f"{name}: the draw uses all lights, so none is held out", hint="Use a smaller --n-lights")
    if whole.lamps is not None or whole.camera_matrix is not None:
        raise UsageError(f"{name}: --relight needs distant lights and an orthographic camera")
    estimate = estimate_normals(given, estimator)
    normals = estimate.normal_map[given.mask]
    confidence = None if estimate.confidence_map is None else estimate.confidence_map[given.mask]
    lights = whole.light_directions[held]
    reached = lights_that_reach(estimate.normal_map, given.mask, lights)
    nearest = (lights @ given.light_directions.T).argmax(axis=1)
    judge = partial(likeness, whole.observations[:, held])
    return RelightingReport(
        capture=name,
        method=estimator.name,
        lights=list(given.light_indices),
        held_out=len(held),
        material=judge(render_gray(material_of(estimate), normals, lights, reached, confidence)),
        lambertian=judge(lambertian(given, normals, lights) * reached),
        nearest=judge(given.observations[:, nearest]),
    )


def likeness(photographs: Float32Array, pictures: Float32Array) -> Likeness:
    """Compare pictures with photographs, both (P, F) and linear. The photographs are not all black.

    White is the 0.999 quantile of the photographs; brighter values are clipped.
    """
    white = max(float(np.quantile(photographs, 0.999)), 1e-12)
    wrong = np.minimum(pictures, white) - np.minimum(photographs, white)
    square = max(float(np.square(wrong, dtype=np.float64).mean()) / white**2, 1e-12)
    error = float(np.abs(wrong).mean() / photographs.mean())
    return Likeness(psnr_db=round(-10 * float(np.log10(square)), 2), error=round(error, 4))


def lambertian(given: Capture, normals: Float32Array, lights: Floats) -> Float32Array:
    """Return pictures (P, F) of a matte surface under lights (F, 3), with the albedo that `infer` computes."""
    cosines = (normals @ given.light_directions.T).astype(np.float32)
    weights = agreeing_lights(given.observations, cosines) * cosines
    albedo = (weights * given.observations).sum(axis=1) / np.maximum((weights * cosines).sum(axis=1), 1e-6)
    return np.asarray(albedo[:, None] * (normals @ lights.T).clip(0), np.float32)
