"""Random materials, from matte to metal, for generated pixels and rendered scenes."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from splinecli.workshop.synthesis import draw_uniform
from splinecli.workshop.synthesis.principled import PrincipledMaterial

# Thresholds on the uniform number that selects the kind of material: matte below the first, then as
# named; and the material classes of the rendered scenes as ranges of that number.
_SHINY, _METAL, _HALF_METAL = 0.30, 0.58, 0.86


CLASSES = {"diffuse": (0.0, _SHINY), "specular": (_SHINY, _METAL), "metallic": (_METAL, 1.0)}


def choose(
    condition: Tensor, first: PrincipledMaterial, second: PrincipledMaterial
) -> PrincipledMaterial:
    """Return the materials of `first` where the condition (P, 1) is true, and of `second`
    elsewhere.

    Both have P pixels.
    """
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return PrincipledMaterial(*(torch.where(condition, one, other) for one, other in pairs))


def draw_material(
    pixels: int, generator: torch.Generator, kinds: tuple[float, float] = (0.0, 1.0)
) -> PrincipledMaterial:
    """Draw random materials: 30 % matte, 28 % specular, 28 % metallic, 14 % half metallic.

    base: U(0.05, 1); 10^U(-1.7, 0) for half of the non-metals, because many real surfaces are dark.
    roughness: U(0.05, 1); U(0.1, 0.9) for metals.
    specular: U(0, 1); U(1, 4) for half of the specular class.
    metallic: 0, 1 or U(0, 1); intermediate values model metallic paints and gilding with a patina.
    sheen: U(0, 1) on a fifth of the dielectrics.
    clearcoat: U(0, 1) on 10 %, and U(1, 4), a full coat of lacquer, on 15 %; gloss U(0, 1).
    interface_loss: U(0, 1) on 60 %. minnaert: U(0.85, 1.5) on 70 %. tail_exponent: U(1.1, 2) on 50
    %. second_share: U(0, 0.7) on 40 % of the metals and half metals and on 15 % of the others;
    second_roughness: U(0.1, 0.8).
    retro: 10^U(-1.3, 0) on 8 % of the non-metals.

    The measured MERL materials fall off faster than the cosine: the median exponent of n.l over the
    non-metals is 1.14, and nine tenths are between 0.86 and 1.47. The ranges of base and minnaert
    were chosen to approximate this. `kinds` is the range of the uniform number that selects the
    kind.
    """

    def uniform(low: float = 0.0, high: float = 1.0) -> Tensor:
        return draw_uniform(generator, pixels, 1, low=low, high=high)

    kind, split = uniform(*kinds), uniform()
    metal = (kind >= _METAL) & (kind < _HALF_METAL)
    blend = kind >= _HALF_METAL
    shiny = (kind >= _SHINY) & (kind < _METAL)
    zero, one = torch.zeros_like(kind), torch.ones_like(kind)
    coat, dark = uniform(), (uniform() < 0.5) & ~metal
    has_second = uniform() < torch.where(metal | blend, 0.4, 0.15)
    return PrincipledMaterial(
        base=torch.where(dark, 10 ** uniform(-1.7, 0.0), uniform(0.05, 1.0)),
        metallic=torch.where(metal, one, torch.where(blend, uniform(), zero)),
        specular=torch.where(shiny & (split < 0.5), uniform(1.0, 4.0), uniform()),
        roughness=torch.where(metal | blend, uniform(0.1, 0.9), uniform(0.05, 1.0)),
        sheen=torch.where((uniform() < 0.2) & ~metal, uniform(), zero),
        clearcoat=torch.where(
            coat < 0.1, uniform(), torch.where(coat < 0.25, uniform(1.0, 4.0), zero)
        ),
        clearcoat_gloss=uniform(),
        interface_loss=torch.where(uniform() < 0.6, uniform(), zero),
        minnaert=torch.where(uniform() < 0.7, uniform(0.85, 1.5), one),
        tail_exponent=torch.where(uniform() < 0.5, uniform(1.1, 2.0), one + 1),
        second_share=torch.where(has_second, uniform(0.0, 0.7), zero),
        second_roughness=uniform(0.1, 0.8),
        retro=torch.where((uniform() < 0.08) & ~metal, 10 ** uniform(-1.3, 0.0), zero),
    )


def with_one_gloss(material: PrincipledMaterial) -> PrincipledMaterial:
    """Return the materials with the first row's parameters except for the base, as on a painted
    object.

    A metal may have the dark base of another kind, as if it was tarnished.
    """
    first = material.take(
        torch.zeros(len(material.base), dtype=torch.long, device=material.base.device)
    )
    return replace(first, base=material.base)
