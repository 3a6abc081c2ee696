"""What every kind of reflectance offers to the pixel generator and the renderer."""

from __future__ import annotations

from typing import Protocol, Self

from torch import Tensor


class Material(Protocol):
    """The isotropic, gray reflectance of P pixels."""

    def take(self, pixels: slice | Tensor) -> Self:
        """The reflectances of some of the pixels; an index tensor may name one several times."""
        ...

    def shade(self, n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
        """pi times the reflected radiance, BRDF times max(n.l, 0), under unit light (P, D).

        Args:
            n_dot_l: (P, D) cosines of normal and light; negative in attached shadow, where radiance is zero.
            n_dot_v: (P, 1) cosines of normal and viewing direction, positive.
            l_dot_v: (D) or (P, D) cosines of light and viewing direction.
        """
        ...

    def albedo(self) -> Tensor:
        """Share of light from a wide angle that is thrown back (P, 1), about 0 to 1."""
        ...
