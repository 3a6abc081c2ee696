"""Pixels with reflectances of several kinds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splinecli.synthesis.material import Material
from splinecli.synthesis.principled import PrincipledMaterial


@dataclass(frozen=True)
class MixedMaterial:
    """P pixels: pixel p has the reflectance `row[p]` of `parts[kind[p]]`. kind and row are (P,) int64."""

    parts: tuple[Material, ...]
    kind: Tensor
    row: Tensor

    def take(self, pixels: slice | Tensor) -> MixedMaterial:
        """Return the reflectances of some of the pixels. The parts are not copied."""
        return MixedMaterial(self.parts, self.kind[pixels], self.row[pixels])

    def shade(self, n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
        """Return pi times the reflected radiance (P, D). Arguments as in Material.shade."""
        shaded = torch.empty_like(n_dot_l)
        for pixels, material in self._of_each_kind():
            own = l_dot_v if l_dot_v.ndim == 1 else l_dot_v[pixels]
            shaded[pixels] = material.shade(n_dot_l[pixels], n_dot_v[pixels], own)
        return shaded

    def albedo(self) -> Tensor:
        """Return the albedo of each pixel (P, 1)."""
        albedo = torch.empty(len(self.kind), 1, device=self.kind.device)
        for pixels, material in self._of_each_kind():
            albedo[pixels] = material.albedo()
        return albedo

    def _of_each_kind(self) -> list[tuple[Tensor, Material]]:
        found = []
        for kind, part in enumerate(self.parts):
            pixels = (self.kind == kind).nonzero()[:, 0]
            # Most parts cannot handle an empty selection.
            if len(pixels):
                found.append((pixels, part.take(self.row[pixels])))
        return found


def choose(condition: Tensor, first: Material, second: Material) -> Material:
    """Return the reflectances of `first` where condition (P, 1) is true, else of `second`. Both have P pixels."""
    if isinstance(first, PrincipledMaterial) and isinstance(second, PrincipledMaterial):
        # All parameters are tensors, so one pass shades both. A mixture would need two.
        pairs = zip(vars(first).values(), vars(second).values(), strict=True)
        return PrincipledMaterial(*(torch.where(condition, one, other) for one, other in pairs))
    kind = (~condition[:, 0]).long()
    return MixedMaterial((first, second), kind, torch.arange(len(kind), device=kind.device))
