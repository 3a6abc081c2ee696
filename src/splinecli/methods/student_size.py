"""How much a distilled estimator learns, by the size of the capture. This file is imported without PyTorch."""

from dataclasses import dataclass

FEWEST_PIXELS = 64  # the smallest sample that can be learned from


@dataclass(frozen=True)
class StudentSize:
    """How much is learned."""

    sample: int  # number of pixels that the network estimates
    steps: int  # steps of learning
    width: int  # units in each hidden layer of the perceptron


def student_sizes(n_pixels: int) -> tuple[StudentSize, StudentSize]:
    """Return the usual size for a capture of n_pixels, and the size where that one is not enough.

    Each pixel of the sample is learned some 25 times.
    """
    usual = min(round(10_000 * max(1.0, n_pixels / 100_000) ** 0.25), n_pixels // 4)
    larger = min(3 * usual, n_pixels // 2)
    return StudentSize(usual, max(500, usual // 10), 192), StudentSize(larger, max(500, larger // 10), 320)
