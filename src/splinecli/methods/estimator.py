"""What every method of photometric stereo looks like from outside."""

from __future__ import annotations

from typing import Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class Estimator(Protocol):
    """Normals from observations, pixel by pixel.

    name: the method's name in the registry; weights: name and SHA-256 of the weights it uses, or None.
    device and precision: what it computes on and in, for the report.
    fingerprint: name, weights and settings in one text, so that equal ones give equal normals, but for rounding.
    """

    @property
    def name(self) -> str: ...
    @property
    def weights(self) -> dict[str, str] | None: ...
    @property
    def device(self) -> str: ...
    @property
    def precision(self) -> str: ...
    @property
    def fingerprint(self) -> str: ...

    def estimate(
        self, observations: NDArray[np.float32], light_directions: NDArray[np.float64]
    ) -> NDArray[np.floating]:
        """Unit normals (P, 3), x right, y up, z to the camera.

        Args:
            observations: (P, F) linear, already divided by the lights' intensities.
            light_directions: (F, 3) unit vectors towards the lights.

        A pixel that no light reaches has no normal; it gets (0, 0, 1), the least surprising one.
        """
        ...


CONFIDENT_DEG = 5.0
"""Confidence is the probability that a normal is off by no more than this."""


@runtime_checkable
class ConfidentEstimator(Estimator, Protocol):
    """An estimator that may know how sure it is.

    tells_confidence: whether it does; with other weights it may not.
    """

    @property
    def tells_confidence(self) -> bool: ...

    def estimate_with_confidence(
        self, observations: NDArray[np.float32], light_directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Normals (P, 3) as `estimate` gives them, and the probability (P,) that each is within CONFIDENT_DEG.

        0 for a pixel that no light reaches.
        """
        ...


def tells_confidence(estimator: Estimator) -> TypeGuard[ConfidentEstimator]:
    """Whether the estimator knows how sure it is."""
    return isinstance(estimator, ConfidentEstimator) and estimator.tells_confidence
