"""The losses have known values, and agree with independent computations."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from splinecli.maths.observation_map import cell_directions
from splinecli.training.config import Norm
from splinecli.training.objective import AXIS_LENGTH, angles, asymmetric_loss, asymmetries, map_loss, mirror


def at(zenith_deg: float, azimuth_deg: float = 0.0) -> Tensor:
    """A normal (1, 3) by its angles."""
    zenith, azimuth = math.radians(zenith_deg), math.radians(azimuth_deg)
    x, y = math.sin(zenith) * math.cos(azimuth), math.sin(zenith) * math.sin(azimuth)
    return torch.tensor([[x, y, math.cos(zenith)]], dtype=torch.float64)


def random_maps(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# A sine of 1e-6 stands in for zero, so that the gradient is bounded: 6e-5 degrees.
@pytest.mark.parametrize("degrees", [0.0, 0.01, 10.0, 90.0, 179.0, 180.0])
def test_angle(degrees: float) -> None:
    assert math.degrees(angles(at(degrees), at(0)).item()) == pytest.approx(degrees, abs=6e-5)


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 10.0, 180.0])
def test_gradient_of_the_angle_is_finite_and_at_most_one(degrees: float) -> None:
    normals = at(degrees).requires_grad_()
    angles(normals, at(0)).backward()
    assert torch.isfinite(normals.grad).all()
    assert normals.grad.norm() <= 1 + 1e-9
    if degrees == 10:
        # An angle grows by one along the circle.
        assert (normals.grad * at(100)).sum().item() == pytest.approx(1)


@pytest.mark.parametrize(("norm", "expected"), [("mean", (0.4 + 0.3) / 2), ("sum", (1.6 + 0.6) / 2)])
def test_map_loss_is_over_the_known_cells_of_each_pixel(norm: Norm, expected: float) -> None:
    known = torch.zeros(2, 1, 4, 4, dtype=torch.float64)
    known[0, ..., 1:3, 1:3] = 1
    known[1, ..., 0, :2] = 1
    truth = random_maps(2, 1, 4, 4)
    dense = truth + 0.3
    dense[0, 0, 1, 1] = truth[0, 0, 1, 1] - 0.7
    dense[0, 0, 0, 0] = dense[1, 0, 3, 3] = 1e6  # unknown
    # Three cells off by 0.3 and one by 0.7; two cells off by 0.3. Every pixel counts alike.
    assert map_loss(dense, truth, known, norm).item() == pytest.approx(expected)
    assert map_loss(truth, truth, known, norm) == 0
    assert map_loss(dense, truth, torch.zeros_like(known), norm) == 0


@pytest.mark.parametrize("azimuth_deg", [17, 90, 211])
def test_mirror_against_scipy(azimuth_deg: int) -> None:
    size = 16
    maps = random_maps(1, 1, size, size, seed=azimuth_deg)
    x, y = np.meshgrid(*[(np.arange(size) + 0.5) * 2 / size - 1] * 2)
    y = -y
    # The mirror image by angles: azimuth a goes to 2 azimuth_deg - a.
    angle = 2 * math.radians(azimuth_deg) - np.arctan2(y, x)
    column = (np.hypot(x, y) * np.cos(angle) + 1) * size / 2 - 0.5
    row = (1 - np.hypot(x, y) * np.sin(angle)) * size / 2 - 0.5
    expected = map_coordinates(maps[0, 0].numpy(), (row, column), order=1, mode="grid-constant")
    np.testing.assert_allclose(mirror(maps, at(30, azimuth_deg))[0, 0].numpy(), expected, rtol=0, atol=1e-12)


def isotropic_map(normal: Tensor, kind: str, size: int = 32) -> tuple[Tensor, Tensor]:
    """An analytic map (1, 1, w, w) without cast shadows, and the cells of the disc."""
    directions, inside = cell_directions(size)
    directions = directions.double()
    values = (directions @ normal[0]).clamp(min=0)
    if kind == "glossy":
        half = torch.nn.functional.normalize(directions + directions.new_tensor((0.0, 0.0, 1.0)), dim=-1)
        values = 0.5 * values + 0.5 * (half @ normal[0]).clamp(min=0) ** 40 * (values > 0)
    return (values * inside)[None, None], inside.double()[None, None]


def asymmetry(maps: Tensor, normal: Tensor, filled: Tensor) -> float:
    """|D - r(D, n)| for a cell of the disc."""
    return (asymmetries(maps, normal, filled)[0].mean() / filled.sum()).item()


@pytest.mark.parametrize("kind", ["matte", "glossy"])
@pytest.mark.parametrize("zenith_deg", [2, 10, 60])
@pytest.mark.parametrize("azimuth_deg", [45, 17, 290])
def test_an_isotropic_map_is_symmetric_about_its_normal(kind: str, zenith_deg: int, azimuth_deg: int) -> None:
    normal = at(zenith_deg, azimuth_deg)
    maps, filled = isotropic_map(normal, kind)
    found = asymmetry(maps, normal, filled)
    if azimuth_deg % 45 == 0:
        assert found < 1e-7  # the directions' float32
        return
    # Bilinear interpolation: h^2 / 8 times a second derivative of about 1, 5e-4 of the map's range in its
    # middle, and ten times that along the rim, where l_z falls steeply.
    assert found < 3e-3
    fine, fine_filled = isotropic_map(normal, kind, 64)
    assert asymmetry(fine, normal, fine_filled) < 0.6 * found
    if zenith_deg >= 10:
        assert asymmetry(maps, at(zenith_deg, azimuth_deg + 30), filled) > 20 * found


@pytest.mark.parametrize("kind", ["matte", "glossy"])
@pytest.mark.parametrize("azimuth_deg", [67, 203])  # and no multiple of 45 with what is added
@pytest.mark.parametrize("off_deg", [-60, -5, 20])
def test_symmetry_pulls_a_normal_towards_the_right_azimuth(kind: str, azimuth_deg: int, off_deg: int) -> None:
    maps, filled = isotropic_map(at(40, azimuth_deg), kind)

    def loss(normal: Tensor) -> Tensor:
        return asymmetries(maps, normal, filled)[0].mean()

    normal = at(40, azimuth_deg + off_deg).requires_grad_()
    loss(normal).backward()
    along = torch.tensor([[-normal[0, 1].item(), normal[0, 0].item(), 0.0]], dtype=torch.float64)
    slope = (normal.grad * along).sum().item()  # by radian of azimuth
    assert slope * off_deg > 0
    assert abs(slope) > 1
    # A kink of the interpolation or of |.| lies in so short a span only by accident.
    span = 1e-7
    moved = [at(40, azimuth_deg + off_deg + math.degrees(sign * span)) for sign in (1, -1)]
    with torch.no_grad():
        differences = (loss(moved[0]) - loss(moved[1])).item() / (2 * span)
    assert slope == pytest.approx(differences, rel=1e-4)
    # The mirror says nothing of how far the normal is tilted.
    assert (normal.grad * normal.detach() * torch.tensor((1.0, 1.0, 0.0))).sum().abs() < 1e-9 * abs(slope)
    assert normal.grad[0, 2] == 0


@pytest.mark.parametrize("length", [0.0, 1e-9, AXIS_LENGTH / 2, AXIS_LENGTH, 1.0])
def test_gradients_in_the_normal_are_finite(length: float) -> None:
    normal = torch.tensor([[length, 0.0, math.sqrt(1 - length**2)]], dtype=torch.float64, requires_grad=True)
    maps, filled = isotropic_map(at(30, 20), "glossy")
    asymmetries(maps, normal, filled)[0].mean().backward()
    assert torch.isfinite(normal.grad).all()


def test_gradient_in_the_map() -> None:
    filled = cell_directions(8)[1].double().expand(2, 1, 8, 8)
    maps = random_maps(2, 1, 8, 8).requires_grad_()
    normals = torch.cat((at(30, 20), at(50, 200)))

    def both(dense: Tensor) -> Tensor:
        fine, coarse = asymmetries(dense, normals, filled)
        return fine.mean() + asymmetric_loss(fine, coarse, eta=1.0, lambda_c=50.0)

    assert torch.autograd.gradcheck(both, (maps,), eps=1e-8, atol=1e-4)


def four_cells(**cells: float) -> Tensor:
    """A map (1, 1, 4, 4) of halves but for cells named r<row>c<column>."""
    maps = torch.full((1, 1, 4, 4), 0.5, dtype=torch.float64)
    for name, value in cells.items():
        maps[0, 0, int(name[1]), int(name[3])] = value
    return maps


# The axis lies along x, so row 0 mirrors row 3 and row 1 row 2.
@pytest.mark.parametrize(
    ("maps", "fine", "coarse"),
    [
        (four_cells(), 0.0, 0.0),
        # One cell 0.4 too bright, its image 0.4 too dark; of each pooled cell a quarter.
        (four_cells(r0c0=0.9), 0.8, 0.2),
        # Two in one pooled cell add up there; in opposite directions they cancel.
        (four_cells(r0c0=0.9, r1c1=0.7), 1.2, 0.3),
        (four_cells(r0c0=0.9, r1c1=0.1), 1.6, 0.0),
        # A cell and its image alike.
        (four_cells(r0c2=0.9, r3c2=0.9), 0.0, 0.0),
    ],
)
def test_asymmetries_by_hand(maps: Tensor, fine: float, coarse: float) -> None:
    found = asymmetries(maps, at(30, 0), torch.ones_like(maps))
    assert [value.item() for value in found] == pytest.approx([fine, coarse], abs=1e-12)


@pytest.mark.parametrize(
    ("eta", "lambda_c", "expected"),
    [(1.0, 50.0, 0.2 + 50 * 0.8), (0.5, 50.0, 0.3 + 50 * 0.3), (0.1, 2.0, 0.7 + 2 * 0.1), (1.0, 0.0, 0.2)],
)
def test_asymmetric_loss_by_hand(eta: float, lambda_c: float, expected: float) -> None:
    maps = four_cells(r0c0=0.9)  # fine 0.8, coarse 0.2, as above
    loss = asymmetric_loss(*asymmetries(maps, at(30, 0), torch.ones_like(maps)), eta=eta, lambda_c=lambda_c)
    assert loss.item() == pytest.approx(expected)


@pytest.mark.parametrize("azimuth_deg", [0, 17, 123])
def test_gaps_and_the_rim_have_no_gradient(azimuth_deg: int) -> None:
    maps, filled = random_maps(1, 1, 32, 32), cell_directions(32)[1].double()[None, None]
    filled[..., 8:11, 15:19] = 0
    maps = (maps * cell_directions(32)[1]).requires_grad_()
    normal = at(40, azimuth_deg)
    asymmetries(maps, normal, filled)[0].mean().backward()
    touched = maps.grad.abs()
    # Up to 0.001 of an image may come from a cell that is not filled.
    assert (touched * (1 - filled)).max() <= 2.1e-3
    assert touched[0, 0, 16, 3] > 0
    # The cells whose image falls into the gap do not count either.
    image_filled = mirror(filled, normal)
    fine, _ = asymmetries(maps.detach(), normal, filled)
    expected = ((maps - mirror(maps, normal)) * filled * (image_filled > 0.999)).abs().sum()
    assert fine.item() == pytest.approx(expected.item())
    # At 0 the gap of 12 has an image of 12; elsewhere it grows by the reach of the interpolation.
    lost = int((filled * (image_filled <= 0.999)).sum())
    assert lost == 12 if azimuth_deg == 0 else 12 < lost < 200
