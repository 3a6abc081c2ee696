"""The losses have known values, and agree with independent computations."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from pytest import approx
from scipy.ndimage import map_coordinates
from torch.testing import assert_close

from distributions import seeded
from scenes import parametrize
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.maths.observation_map import cell_directions, sparse_map
from splinecli.workshop.synthesis.batches import PixelBatch
from splinecli.workshop.synthesis.pixels import PixelGenerator
from splinecli.workshop.training.config import preset
from splinecli.workshop.training.loop import Trainer
from splinecli.workshop.training.objective import (
    AXIS_LENGTH,
    angles,
    asymmetric_loss,
    asymmetries,
    balanced,
    compute_losses,
    dense_truth_in_frame,
    map_loss,
    mirror,
    to_pixel_frame,
)
from tiny_networks import random_network


def at(zenith_deg, azimuth_deg=0.0):
    """A normal (1, 3) by its angles."""
    zenith, azimuth = math.radians(zenith_deg), math.radians(azimuth_deg)
    x, y = math.sin(zenith) * math.cos(azimuth), math.sin(zenith) * math.sin(azimuth)
    return torch.tensor([[x, y, math.cos(zenith)]], dtype=torch.float64)


def random_maps(*shape, seed=0):
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64)


# A sine of 1e-6 stands in for zero, so that the gradient is bounded: 6e-5 degrees.
@parametrize("degrees", [0.0, 0.01, 10.0, 90.0, 179.0, 180.0])
def test_angle(degrees):
    assert math.degrees(angles(at(degrees), at(0)).item()) == approx(degrees, abs=6e-5)


@parametrize("norm, expected", [("mean", (0.4 + 0.3) / 2), ("sum", (1.6 + 0.6) / 2)])
def test_map_loss_is_over_the_known_cells_of_each_pixel(norm, expected):
    known = torch.zeros(2, 1, 4, 4, dtype=torch.float64)
    known[0, ..., 1:3, 1:3] = 1
    known[1, ..., 0, :2] = 1
    truth = random_maps(2, 1, 4, 4)
    dense = truth + 0.3
    dense[0, 0, 1, 1] = truth[0, 0, 1, 1] - 0.7
    dense[0, 0, 0, 0] = dense[1, 0, 3, 3] = 1e6  # unknown
    # Three cells off by 0.3 and one by 0.7; two cells off by 0.3. Every pixel counts alike.
    assert map_loss(dense, truth, known, norm).item() == approx(expected)
    assert map_loss(truth, truth, known, norm) == 0
    assert map_loss(dense, truth, torch.zeros_like(known), norm) == 0


@parametrize("azimuth_deg", [17, 90, 211])
def test_mirror_against_scipy(azimuth_deg):
    size = 16
    maps = random_maps(1, 1, size, size, seed=azimuth_deg)
    x, y = np.meshgrid(*[(np.arange(size) + 0.5) * 2 / size - 1] * 2)
    y = -y
    # The mirror image by angles: azimuth a goes to 2 azimuth_deg - a.
    angle = 2 * math.radians(azimuth_deg) - np.arctan2(y, x)
    column = (np.hypot(x, y) * np.cos(angle) + 1) * size / 2 - 0.5
    row = (1 - np.hypot(x, y) * np.sin(angle)) * size / 2 - 0.5
    expected = map_coordinates(maps[0, 0].numpy(), (row, column), order=1, mode="grid-constant")
    np.testing.assert_allclose(
        mirror(maps, at(30, azimuth_deg))[0, 0].numpy(), expected, rtol=0, atol=1e-12
    )


@parametrize("length", [0.0, 1e-9, AXIS_LENGTH / 2, AXIS_LENGTH, 1.0])
def test_gradients_in_the_normal_are_finite(length):
    normal = torch.tensor(
        [[length, 0.0, math.sqrt(1 - length**2)]], dtype=torch.float64, requires_grad=True
    )
    asymmetries(random_maps(1, 1, 32, 32), normal, torch.ones(1, 1, 32, 32).double())[
        0
    ].mean().backward()
    assert torch.isfinite(normal.grad).all()


def four_cells(**cells):
    """A map (1, 1, 4, 4) of halves but for cells named r<row>c<column>."""
    maps = torch.full((1, 1, 4, 4), 0.5, dtype=torch.float64)
    for name, value in cells.items():
        maps[0, 0, int(name[1]), int(name[3])] = value
    return maps


# The axis lies along x, so row 0 mirrors row 3 and row 1 row 2. The loss is for eta = 0.1 and
# lambda_c = 2.
@parametrize(
    "maps, filled, fine, coarse, loss",
    [
        (four_cells(), 1.0, 0.0, 0.0, 0.1 + 2 * 0.1),
        # One cell 0.4 too bright, its image 0.4 too dark; of each pooled cell a quarter.
        (four_cells(r0c0=0.9), 1.0, 0.8, 0.2, 0.7 + 2 * 0.1),
        # Two in one pooled cell add up there; in opposite directions they cancel.
        (four_cells(r0c0=0.9, r1c1=0.7), 1.0, 1.2, 0.3, 1.1 + 2 * 0.2),
        (four_cells(r0c0=0.9, r1c1=0.1), 1.0, 1.6, 0.0, 1.5 + 2 * 0.1),
        # A cell and its image alike.
        (four_cells(r0c2=0.9, r3c2=0.9), 1.0, 0.0, 0.0, 0.1 + 2 * 0.1),
        # A cell whose image is a gap does not count, nor does the gap.
        (four_cells(r0c0=0.9), 2 * four_cells(r3c0=0.0), 0.0, 0.0, 0.1 + 2 * 0.1),
    ],
)
def test_asymmetries_by_hand(maps, filled, fine, coarse, loss):
    found = asymmetries(maps, at(30, 0), torch.ones_like(maps) * filled)
    assert [value.item() for value in found] == approx([fine, coarse], abs=1e-12)
    assert asymmetric_loss(*found, eta=0.1, lambda_c=2.0).item() == approx(loss)


CPU = torch.device("cpu")
SILENT = {"angle_weight": 0.0, "map_weight": 0.0, "masked_weight": 0.0}


@pytest.fixture
def network():
    return random_network().train()


@pytest.fixture
def batch(tiny):
    return PixelGenerator(tiny.pixels, seeded(0)).draw(12)


def moved(module):
    """Whether any parameter has a gradient other than zero."""
    return any(p.grad is not None and bool(p.grad.any()) for p in module.parameters())


def test_a_step_for_one_network_leaves_the_other_bitwise_alone(tiny, tmp_path):
    config = replace(
        tiny,
        updates="alternating",
        ne_net_updates=2,
        weight_decay=0.1,
        learning_rate=1e-2,
        symmetric_weight=0.02,
        asymmetric_weight=1e-4,
    )
    trainer = Trainer(config, tmp_path, CPU)

    def state(name):
        return [p.detach().clone() for p in getattr(trainer.network, name).parameters()]

    # Momentum of earlier steps and weight decay must not move what is fixed, either.
    for step in range(7):
        fixed, updated = ("ne_net", "li_net") if step % 3 == 2 else ("li_net", "ne_net")
        before, old = state(fixed), state(updated)
        trainer.step()
        assert all(torch.equal(a, b) for a, b in zip(before, state(fixed), strict=True))
        assert not all(torch.equal(a, b) for a, b in zip(old, state(updated), strict=True))


def test_the_angle_reaches_li_net_through_the_fixed_ne_net(tiny, network, batch):
    config = replace(tiny, **SILENT | {"angle_weight": 1.0})
    compute_losses(network, batch, config, part="li_net").total.backward()
    assert moved(network.li_net)
    assert not moved(network.ne_net)


@parametrize("part", "both ne_net li_net")
def test_the_total_is_the_weighted_sum_of_its_terms(tiny, network, batch, part):
    config = replace(
        tiny,
        angle_weight=0.7,
        map_weight=0.5,
        masked_weight=0.3,
        symmetric_weight=0.02,
        asymmetric_weight=1e-3,
        eta=2.0,
        lambda_c=10.0,
        li_net_norm="mean",
        ne_net_norm="sum",
    )
    with torch.no_grad():
        found = compute_losses(network, batch, config, part=part)
        views = network.build_maps(batch.observations, batch.light_directions, batch.valid)
        truth = dense_truth_in_frame(batch, views, size=32)
        dense = network.interpolate(views)
        normals = network.estimate(views, dense).normals
        # by the paper's formulas (eqs. 5 and 8)
        special = []
        for name, maps, axes, share in (
            ("li_net", dense, to_pixel_frame(batch.truth.normals, views), 1 / 812),
            ("ne_net", truth.values, normals, 1.0),
        ):
            if part in ("both", name):
                fine, coarse = asymmetries(maps, axes, truth.filled)
                both = fine.mean(), asymmetric_loss(fine, coarse, eta=2.0, lambda_c=10.0)
                special.append(share * torch.stack(both))
    symmetric, asymmetric = torch.stack(special).sum(0)
    assert_close((found.symmetric, found.asymmetric), (symmetric, asymmetric), rtol=1e-5, atol=0)
    total = 0.7 * found.angle + 0.02 * symmetric + 1e-3 * asymmetric
    if part != "ne_net":
        total += 0.5 * found.on_map + 0.3 * found.masked
    assert found.total.item() == approx(total.item(), rel=1e-5)


def test_a_degree_counts_more_on_a_capture_that_is_nearly_right():
    errors = torch.tensor([math.radians(1.0), math.radians(20.0)], requires_grad=True)
    (gradient,) = torch.autograd.grad(balanced(errors), errors)
    assert (gradient[0] / gradient[1]).item() == approx(math.sqrt(22.5 / 3.5))
    typical = torch.tensor([math.radians(2.5)] * 3)
    assert balanced(typical).item() == approx(typical[0].item())
    assert balanced(typical, torch.full((3,), math.radians(7.5))).item() == approx(
        typical[0].item() / 2**0.5
    )


@parametrize("mirror", [False, True])
def test_truth_agrees_with_what_the_network_sees(tiny, mirror):
    # Without a camera's faults, the true dense map at a light in a cell's centre is the sparse map
    # there.
    network = SplineNet(tiny.network)
    batch = PixelGenerator(tiny.pixels, seeded(0)).draw(40)
    directions, inside = cell_directions()
    lights = directions[inside][3::29]
    exposure = torch.linspace(0.3, 2, 40)[:, None]
    observations = batch.truth.radiance(lights) * exposure  # type: ignore[attr-defined]
    seen = PixelBatch(
        observations,
        lights,
        torch.ones_like(observations) > 0,
        batch.truth,
        exposure,
        len(exposure),
    )
    # Without a turn beyond multiples of 90 degrees, centres stay centres.
    views = network.build_maps(observations, lights)._replace(
        cosine=torch.zeros(40), sine=torch.ones(40), mirrored=mirror
    )
    dense = dense_truth_in_frame(seen, views, size=32)
    normals = to_pixel_frame(seen.truth.normals, views)
    turned = torch.stack((-lights[:, 1], lights[:, 0], lights[:, 2]), dim=1)
    expected_normals = torch.stack(
        (-seen.truth.normals[:, 1], *seen.truth.normals[:, [0, 2]].unbind(1)), dim=1
    )
    if mirror:
        turned, expected_normals = (
            vectors * torch.tensor((1.0, -1.0, 1.0)) for vectors in (turned, expected_normals)
        )
    sparse = sparse_map(observations / views.scale, turned)
    assert sparse.occupied[0].sum() == len(lights)
    assert_close(dense.values * sparse.occupied, sparse.values.clamp(max=1), rtol=2e-3, atol=1e-4)
    assert_close(normals, expected_normals)
    assert dense.values.max() == 1  # highlights that no light has hit are cut
    assert torch.equal(dense.known, inside.float().expand(40, 1, 32, 32))
    assert torch.equal(dense.filled, dense.known)


def test_without_li_net_the_angle_is_all(tiny, batch):
    # CNN-PS: no dense map is drawn or judged, and NE-Net learns from the angle alone.
    torch.manual_seed(0)
    network = SplineNet(NetworkConfig(size="paper", interpolates=False))
    losses = compute_losses(network, batch, preset("cnn-ps"))
    assert torch.equal(losses.total, losses.angle)
    assert all(torch.isnan(term) for term in losses[2:])
    losses.total.backward()
    assert all(
        parameter.grad is not None and parameter.grad.any() for parameter in network.parameters()
    )
