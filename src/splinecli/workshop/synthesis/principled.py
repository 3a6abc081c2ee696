"""The principled BRDF (Burley, "Physically Based Shading at Disney", SIGGRAPH 2012) for pixels
viewed from +z.

The BRDF is isotropic and gray. A pixel's observation is the mean of its colour channels, and the
model is nearly linear in the base colour, so one channel is enough. Every parameter is a tensor (P,
1).

materials/lobes.py has the lobes that are also fitted to photographs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from splinecli.materials.lobes import facets, half_vector_cosines, power, schlick_weight, smith_ggx


@dataclass(frozen=True)
class PrincipledMaterial:
    """Parameters of the principled BRDF, each (P, 1), in Burley's ranges; specular reaches 4, as in
    CyclesPS.

    The last six are additions to Burley's model.
    """

    base: Tensor
    metallic: Tensor
    specular: Tensor
    roughness: Tensor
    sheen: Tensor
    clearcoat: Tensor
    clearcoat_gloss: Tensor
    # If above 0, the diffuse light loses this share at grazing angles, both entering and leaving,
    # as through the smooth surface of a plastic or a glaze. Burley's retro-reflection is then left
    # out.
    interface_loss: Tensor
    # kappa of Minnaert's law. The diffuse light is multiplied by (n.l n.v)^(kappa - 1): below 1 the
    # falloff is flat as on dust, above 1 steep as on marble.
    minnaert: Tensor
    # gamma of the highlight's distribution (generalised Trowbridge-Reitz), above 1 and at most 2. 2
    # is GGX; smaller values give longer tails.
    tail_exponent: Tensor
    # share of the facets that form a second highlight, such as the flakes of a metallic paint
    second_share: Tensor
    second_roughness: Tensor  # the roughness of the second set of facets
    # a lobe towards the light, as of fabrics, dust and road paint, in units of the base colour
    retro: Tensor

    def take(self, pixels: slice | Tensor) -> PrincipledMaterial:
        """Return the materials of some of the pixels. An index tensor may repeat pixels."""
        return PrincipledMaterial(*(getattr(self, field.name)[pixels] for field in fields(self)))

    def shade(self, n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
        """Return pi times the reflected radiance, the BRDF times max(n.l, 0), under unit light (P,
        D).

        n_dot_l (P, D) is negative in attached shadow, where radiance is zero. n_dot_v (P, 1) is
        positive. l_dot_v is (D) or (P, D).
        """
        lit = n_dot_l.clamp(min=0)
        l_dot_h, n_dot_h_squared = half_vector_cosines(n_dot_l, n_dot_v, l_dot_v)
        fresnel = schlick_weight(l_dot_h)

        grazing_90 = torch.where(
            self.interface_loss > 0,
            -self.interface_loss,
            2 * self.roughness * l_dot_h * l_dot_h - 0.5,
        )
        diffuse = (1 + grazing_90 * schlick_weight(lit)) * (
            1 + grazing_90 * schlick_weight(n_dot_v)
        )
        if bool((self.minnaert != 1).any()):
            diffuse = diffuse * power((lit * n_dot_v).clamp(min=1e-4), self.minnaert - 1)
        if bool((self.retro > 0).any()):
            # The retro-reflective lobe is ((1 + l.v) / 2)^20, half as high where light and view are
            # 21 degrees apart.
            diffuse = diffuse + self.retro * l_dot_h ** (2 * 20)
        diffuse = (1 - self.metallic) * (self.base * diffuse + math.pi * self.sheen * fresnel)

        f0 = (0.08 * self.specular * (1 - self.metallic) + self.base * self.metallic).clamp(max=1)
        specular = facets(n_dot_h_squared, lit, n_dot_v, self.roughness, self.tail_exponent)
        if bool((self.second_share > 0).any()):
            ggx = torch.full_like(self.tail_exponent, 2.0)
            second = facets(n_dot_h_squared, lit, n_dot_v, self.second_roughness, ggx)
            specular = torch.lerp(specular, second, self.second_share)
        radiance = diffuse + specular * (f0 + (1 - f0) * fresnel)

        if bool((self.clearcoat > 0).any()):
            coat_alpha_squared = (0.1 + (0.001 - 0.1) * self.clearcoat_gloss) ** 2
            coat = (coat_alpha_squared - 1) / (
                coat_alpha_squared.log() * (1 + (coat_alpha_squared - 1) * n_dot_h_squared)
            )
            quarter = torch.full_like(n_dot_v, 0.25**2)
            coat = (
                coat
                * smith_ggx(n_dot_v, quarter)
                * smith_ggx(lit, quarter)
                * (0.04 + 0.96 * fresnel)
            )
            radiance = radiance + 0.25 * self.clearcoat * coat
        return radiance * lit

    def albedo(self) -> Tensor:
        """Return the diffuse albedo plus the mean specular reflectance (P, 1)."""
        return self.base + 0.08 * self.specular * (1 - self.metallic)
