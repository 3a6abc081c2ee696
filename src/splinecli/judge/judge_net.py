"""Estimate the probability of each other reading of the images with a small network.

Its features are the residuals under all readings (explanations.py) and independent evidence, each
before and after the reading: how well three images explain all others (the factors of light_fit.py,
which do not depend on the lights), how well the lights fit these factors, and the curl of the
normals. It was trained on rendered captures of all material classes, with and without faults
(benchmarks/train_judge_net.py).
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import NamedTuple, Protocol

import numpy as np

from splinecli.capture.sample import Sample
from splinecli.judge.explanations import ALL_KINDS, Explanation, Explanations
from splinecli.judge.tilt import Tilt, curl_of, fitted_map
from splinecli.lights.light_fit import Factors
from splinecli.lights.outline import turn_at_outline
from splinecli.maths import Float64Array, Floats
from splinecli.maths.normals import angle_between_deg, spread_of, unit

RIGHT, TRANSLUCENT, TILTED = "right", "translucent", "tilted"
CLASSES = (RIGHT, TRANSLUCENT, TILTED, *ALL_KINDS)
_LARGEST = 15.0  # absolute value of a feature
_LEAST = 3e-3  # added to residuals before a logarithm is taken


class Judged(Protocol):
    """The evidence from which the features are computed; see Evidence."""

    @property
    def directions(self) -> Float64Array: ...
    @property
    def evened(self) -> Sample: ...
    @property
    def normals(self) -> Floats: ...
    @property
    def factors(self) -> Factors | None: ...
    @property
    def explanations(self) -> Explanations: ...
    @property
    def tilt(self) -> Tilt | None: ...
    @property
    def intensities_measured(self) -> bool: ...
    @property
    def estimated(self) -> Float64Array | None: ...
    @property
    def eight_bit(self) -> bool: ...
    @property
    def coarse(self) -> Judged: ...

    def read_as(self, reading: Explanation) -> Judged: ...


class JudgeNet(NamedTuple):
    """The weights of M perceptrons with one hidden layer, whose probabilities are averaged."""

    mean: Float64Array  # (D,), of the features in training
    deviation: Float64Array  # (D,), standard deviation
    hidden: Float64Array  # (M, D, H)
    hidden_bias: Float64Array  # (M, H)
    output: Float64Array  # (M, H, C), of the CLASSES
    output_bias: Float64Array  # (M, C)

    def probabilities(self, features: Float64Array) -> Float64Array:
        """Return the probabilities (..., C) of CLASSES from features (..., D)."""
        # The output is held constant beyond the range of the features in training.
        scaled = ((features - self.mean) / self.deviation).clip(-3, 3)
        hidden = np.tanh(np.einsum("...d,mdh->...mh", scaled, self.hidden) + self.hidden_bias)
        logits = np.einsum("...mh,mhc->...mc", hidden, self.output) + self.output_bias
        found = np.exp(logits - np.logaddexp.reduce(logits, axis=-1, keepdims=True))
        return np.asarray(found.mean(axis=-2))


@cache
def judge_net() -> JudgeNet:
    """Load the shipped network."""
    from safetensors.numpy import load

    stored = (files("splinecli") / "assets" / "judge-net.safetensors").read_bytes()
    return JudgeNet(
        **{name: np.asarray(values, np.float64) for name, values in load(stored).items()}
    )


def features_of(seen: Judged) -> Float64Array | None:
    """Return the features (D,) of the evidence; None if it has no readings.

    The features of a reading that the lights do not determine are 0.
    """
    readings = seen.explanations.readings
    if not readings:
        return None
    fits, before = seen.explanations, _measures(seen.coarse)
    found = [
        *np.log(before + _LEAST),
        np.log(fits.given.residual + _LEAST),
        np.log(len(seen.directions) / 10),
        np.log(np.linalg.svd(seen.directions, compute_uv=False)[-1] / len(seen.directions) ** 0.5),
        np.log(spread_of(unit(fits.given.normals)) + 0.01),
        fits.roundness,
        float(seen.intensities_measured),
        float(seen.estimated is not None),
        float(seen.eight_bit),
    ]
    found += _of_tilt(seen)
    for kind in ALL_KINDS:
        reading = readings.get(kind)
        if reading is None:
            found += [0.0] * (3 + len(before))
            continue
        after = _measures(seen.coarse.read_as(reading))
        found += [
            np.log(reading.ratio),
            _amount(reading),
            float(np.std(np.log(reading.intensities))),
            *(np.log(after + _LEAST) - np.log(before + _LEAST)),
        ]
    # The curl of a plane is 0, and its logarithm infinite.
    return np.asarray(np.nan_to_num(np.array(found)).clip(-_LARGEST, _LARGEST), np.float64)


def _of_tilt(seen: Judged) -> list[float]:
    """Return the features of a common tilt of the lights, from the curl and the outline."""
    tilt, lights = seen.tilt, seen.directions
    found = [0.0] * 4
    if tilt is not None:
        found = [
            float(np.log(tilt.left)),
            float(np.log1p(tilt.degrees)),
            float(np.log1p(max(tilt.significance, 0))),
            float(np.log(tilt.left * tilt.curl + _LEAST)),
        ]
    coarse = seen.coarse.evened
    turn = turn_at_outline(coarse.observations, coarse.mask, lights)
    if tilt is None or turn is None:
        return found + [0.0] * 5
    turned = lights @ turn.share(1.0).T
    curl = curl_of(fitted_map(coarse.observations, coarse.mask, turned), coarse.mask)
    agreement = float(np.median(angle_between_deg(turned, lights @ tilt.matrix.T)))
    return [
        *found,
        1.0,
        float(np.log1p(turn.angle_deg)),
        turn.spread,
        float(np.log(curl + _LEAST) - np.log(tilt.curl + _LEAST)),
        float(np.log1p(agreement)),
    ]


def _amount(reading: Explanation) -> float:
    return float(reading.amount if reading.kind == "curve" else np.log(reading.amount))


def _measures(seen: Judged) -> Float64Array:
    """Return the residual of explaining all images by three, the misfits of the lights with known
    and with free intensities, and the curl of the normals; NaN if unknown.
    """
    curl = curl_of(seen.normals, seen.evened.mask)
    factors, lights = seen.factors, seen.directions[None]
    if factors is None:
        return np.array((np.nan, np.nan, np.nan, curl))
    free = factors.with_free_intensities()
    return np.array((factors.residual, *(f.misfits(lights)[0] for f in (factors, free)), curl))
