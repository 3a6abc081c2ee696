"""The principled BRDF against its equations, written out a second time in numpy with explicit
vectors.
"""

from dataclasses import fields

import numpy as np
import pytest
import torch
from pytest import approx
from scipy import integrate

from distributions import seeded
from splinecli.maths.normals import unit
from splinecli.workshop.synthesis.draw_materials import draw_material
from splinecli.workshop.synthesis.principled import PrincipledMaterial

NAMES = tuple(field.name for field in fields(PrincipledMaterial))


def material(**values):
    plain = (
        dict.fromkeys(NAMES, 0.0)
        | {"base": 0.5, "roughness": 0.5, "minnaert": 1.0, "tail_exponent": 2.0}
        | values
    )
    return PrincipledMaterial(
        **{name: torch.tensor([[value]], dtype=torch.float64) for name, value in plain.items()}
    )


def hemisphere(count, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    vectors[:, 2] = np.abs(vectors[:, 2])
    return unit(vectors)


def radiance(surface, normal, lights):
    n_dot_l = torch.from_numpy(lights @ normal)[None]
    return surface.shade(
        n_dot_l, torch.tensor([[normal[2]]]), torch.from_numpy(lights[:, 2])
    ).numpy()[0]


def burley(surface, n, lights):
    """pi f cos(theta_l), Burley 2012, section 5 and appendix B; specular G without the 2012
    remapping.

    The height of the highlight's distribution by quadrature: projected facets have unit area.
    """
    (
        base,
        metallic,
        specular,
        roughness,
        sheen,
        clearcoat,
        gloss,
        loss,
        kappa,
        gamma,
        share,
        second,
        retro,
    ) = (float(getattr(surface, name)) for name in NAMES)

    def facets(nh, nl, nv, roughness, gamma):
        alpha = max(roughness, 0.1) ** 2
        area, _ = integrate.quad(
            lambda x: 2 * np.pi * x / (1 + (alpha**2 - 1) * x * x) ** gamma,
            0,
            1,
            points=[1 - alpha**2],
            epsrel=1e-9,
        )
        ndf = 1 / area / (nh**2 * (alpha**2 - 1) + 1) ** gamma
        return float(ndf * g1(nl, alpha) * g1(nv, alpha))

    def schlick(cosine):
        return float((1 - cosine) ** 5)

    def g1(cosine, alpha):
        tangent = np.sqrt(1 - cosine**2) / cosine
        return float(2 / (1 + np.sqrt(1 + (alpha * tangent) ** 2)))

    v = np.array([0.0, 0.0, 1.0])
    result = []
    for light in lights:
        nl, nv = n @ light, n @ v
        if nl <= 0:
            result.append(0.0)
            continue
        h = (light + v) / np.linalg.norm(light + v)
        nh, lh = n @ h, light @ h
        fd90 = 1 - loss if loss else 0.5 + 2 * roughness * lh**2
        diffuse = base / np.pi * (1 + (fd90 - 1) * schlick(nl)) * (1 + (fd90 - 1) * schlick(nv))
        diffuse *= (nl * nv) ** (kappa - 1)
        diffuse += base / np.pi * retro * ((1 + light @ v) / 2) ** 20
        f0 = (1 - metallic) * 0.08 * specular + metallic * base
        fresnel = f0 + (1 - f0) * schlick(lh)
        lobe = (1 - share) * facets(nh, nl, nv, roughness, gamma) + share * facets(
            nh, nl, nv, second, 2
        )
        lobe *= fresnel / (4 * nl * nv)
        coat_alpha = 0.1 * (1 - gloss) + 0.001 * gloss
        coat_ndf = (coat_alpha**2 - 1) / (
            np.pi * np.log(coat_alpha**2) * (1 + (coat_alpha**2 - 1) * nh**2)
        )
        coat_fresnel = 0.04 + 0.96 * schlick(lh)
        coat = coat_ndf * coat_fresnel * g1(nl, 0.25) * g1(nv, 0.25) / (4 * nl * nv)
        f = (1 - metallic) * (diffuse + sheen * schlick(lh)) + lobe + 0.25 * clearcoat * coat
        result.append(np.pi * f * nl)
    return np.array(result)


@pytest.mark.parametrize(
    "surface",
    [
        material(roughness=0.0),
        material(specular=4.0, roughness=0.15),
        material(interface_loss=1.0, specular=0.5),
        material(minnaert=1.4, sheen=0.3),
        material(
            metallic=1.0, roughness=0.3, tail_exponent=1.6, clearcoat=4.0, clearcoat_gloss=0.5
        ),
        material(metallic=1.0, roughness=0.6, second_share=0.3, second_roughness=0.2),
        material(specular=2.0, tail_exponent=1.5, second_share=0.7, second_roughness=0.8),
        material(retro=0.5),
        material(clearcoat=0.6, clearcoat_gloss=0.9, specular=0.5, metallic=0.5, sheen=0.4),
    ],
)
def test_agrees_with_the_published_equations(surface):
    lights = hemisphere(300)
    for normal in hemisphere(4, seed=1):
        expected = burley(surface, normal, lights)
        assert expected.any()
        np.testing.assert_allclose(
            radiance(surface, normal, lights), expected, rtol=1e-5, atol=1e-12
        )


def test_float32_is_close_to_float64():
    surface = draw_material(200, seeded(0))
    double = PrincipledMaterial(*(getattr(surface, name).double() for name in NAMES))
    lights = torch.from_numpy(hemisphere(100))
    normals = torch.from_numpy(hemisphere(200, seed=2)) + torch.tensor((0.0, 0.0, 0.2))
    normals = torch.nn.functional.normalize(normals, dim=1)
    exact = double.shade(normals @ lights.T, normals[:, 2:], lights[:, 2])
    coarse = surface.shade(
        (normals @ lights.T).float(), normals[:, 2:].float(), lights[:, 2].float()
    )
    assert torch.isfinite(coarse).all()
    # Half a per cent in a peak of the narrowest lobes, whose height float32 resolves no better.
    assert ((coarse - exact).abs() / (exact + 0.01)).max() < 5e-3


def test_drawn_materials_have_the_stated_classes():
    drawn = draw_material(40_000, seeded(0))
    values = {name: getattr(drawn, name).numpy().ravel() for name in NAMES}
    metal, blend = values["metallic"] == 1, (values["metallic"] > 0) & (values["metallic"] < 1)
    for flags, share in (
        (metal, 0.28),
        (blend, 0.14),
        (values["specular"] > 1, 0.28 / 2),
        ((values["second_share"] > 0)[metal | blend], 0.4),
        ((values["second_share"] > 0)[~(metal | blend)], 0.15),
    ):
        # four standard deviations
        assert flags.mean() == approx(share, abs=4 * np.sqrt(0.25 / len(flags)))
    assert (values["specular"][metal] <= 1).all() and values["base"][metal].min() >= 0.05
    assert not values["sheen"][metal].any() and not values["retro"][metal].any()
    rough = values["roughness"]
    assert 0.1 <= rough[metal | blend].min() < rough[metal | blend].max() <= 0.9
    assert rough[~(metal | blend)].min() == approx(0.05, abs=0.01)
    assert rough.max() == approx(1, abs=0.01)


def test_light_from_behind_what_is_seen_is_finite():
    surface = draw_material(50, seeded(0))
    view = torch.full((50, 1), 0.5)
    for l_dot_v in (-1.0, -1.0000001):
        assert torch.isfinite(surface.shade(-view, view, torch.full((50, 1), l_dot_v))).all()
