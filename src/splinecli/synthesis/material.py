"""The interface of reflectances for the pixel generator and the renderer."""

from __future__ import annotations

from typing import Protocol, Self

from torch import Tensor


class Material(Protocol):
    """The isotropic, gray reflectance of P pixels."""

    def take(self, pixels: slice | Tensor) -> Self:
        """Return the reflectances of some of the pixels. An index tensor may name a pixel several times."""
        ...

    def shade(self, n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
        """Return pi times the reflected radiance, the BRDF times max(n.l, 0), under unit light (P, D).

        Args:
            n_dot_l: (P, D) cosines of normal and light. They are negative in attached shadow, where radiance is zero.
            n_dot_v: (P, 1) cosines of normal and viewing direction, positive.
            l_dot_v: (D) or (P, D) cosines of light and viewing direction.
        """
        ...

    def albedo(self) -> Tensor:
        """Return the share of light from a wide angle that is reflected (P, 1), about 0 to 1."""
        ...
