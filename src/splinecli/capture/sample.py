"""A sample of the pixels of a capture."""

from dataclasses import dataclass

from splinecli.maths import Bools, Floats


@dataclass(frozen=True, eq=False)
class Sample:
    """Observations on a grid of pixels."""

    # (p, F), linear, divided by the light intensities; pixels of the mask in row-major order
    observations: Floats
    mask: Bools  # (h, w) bool with p true pixels
    step: int  # rows and columns of the images from one pixel of the grid to the next
