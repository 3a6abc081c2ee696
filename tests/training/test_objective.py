"""What is minimised: which terms, by which weights, and whose parameters they move."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from splinecli.maths.observation_map import cell_directions, sparse_map
from splinecli.networks.config import NetworkConfig
from splinecli.networks.spline_net import SplineNet, to_pixel_frame
from splinecli.synthesis.batches import PixelBatch
from splinecli.synthesis.pixels import PixelGenerator
from splinecli.training.config import TrainingConfig, preset
from splinecli.training.loop import Trainer
from splinecli.training.objective import (
    angles,
    asymmetric_loss,
    asymmetries,
    balanced,
    compute_losses,
    dense_truth_in_frame,
    part_of_step,
)
from tiny_networks import random_network

CPU = torch.device("cpu")
SILENT = {"angle_weight": 0.0, "map_weight": 0.0, "masked_weight": 0.0}


@pytest.fixture
def network() -> SplineNet:
    return random_network().train()


@pytest.fixture
def batch(tiny: TrainingConfig) -> PixelBatch:
    return PixelGenerator(tiny.pixels, torch.Generator().manual_seed(0)).draw(12)


def moved(module: nn.Module) -> bool:
    """Whether any parameter has a gradient other than zero."""
    return any(p.grad is not None and bool(p.grad.any()) for p in module.parameters())


def test_five_steps_for_ne_net_then_one_for_li_net(tiny: TrainingConfig) -> None:
    alternating = replace(tiny, updates="alternating")
    parts = [part_of_step(alternating, step) for step in range(12)]
    assert parts == (["ne_net"] * 5 + ["li_net"]) * 2
    parts = [part_of_step(replace(alternating, ne_net_updates=1), step) for step in range(3)]
    assert parts == ["ne_net", "li_net", "ne_net"]
    assert {part_of_step(tiny, step) for step in range(12)} == {"both"}


def test_a_step_for_one_network_leaves_the_other_bitwise_alone(tiny: TrainingConfig, tmp_path: Path) -> None:
    config = replace(
        tiny, updates="alternating", ne_net_updates=2, weight_decay=0.1, learning_rate=1e-2,
        symmetric_weight=0.02, asymmetric_weight=1e-4,
    )  # fmt: skip
    trainer = Trainer(config, tmp_path, CPU)

    def state(name: str) -> list[Tensor]:
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


@pytest.mark.parametrize("part", ["both", "ne_net", "li_net"])
@pytest.mark.parametrize(("li_net_norm", "ne_net_norm"), [("mean", "sum"), ("sum", "mean")])
def test_the_total_is_the_weighted_sum_of_its_terms(tiny, network, batch, part, li_net_norm, ne_net_norm):
    config = replace(
        tiny, angle_weight=0.7, map_weight=0.5, masked_weight=0.3, symmetric_weight=0.02,
        asymmetric_weight=1e-3, eta=2.0, lambda_c=10.0, li_net_norm=li_net_norm, ne_net_norm=ne_net_norm,
    )  # fmt: skip
    with torch.no_grad():
        found = compute_losses(network, batch, config, part=part)
        views = network.build_maps(batch.observations, batch.light_directions, batch.valid)
        dense_truth = dense_truth_in_frame(batch, views, size=32)
        normal_truth = to_pixel_frame(batch.truth.normals, views)
        dense = network.interpolate(views)
        normals = network.estimate(views, dense).normals
        cells = cell_directions(32)[1].sum()
        # Each term by the paper's formulas (eqs. 5 and 8).
        error = (dense - dense_truth.values).abs()
        on_map = (error * dense_truth.known).sum((1, 2, 3))
        masked = (error * dense_truth.known * views.occupied).sum((1, 2, 3))
        seen = (dense_truth.known * views.occupied).sum((1, 2, 3))
        angle = (normals * normal_truth).sum(1).clamp(-1, 1).acos().mean()
        special = {}
        for name, maps, axes, norm in (
            ("li_net", dense, normal_truth, li_net_norm),
            ("ne_net", dense_truth.values, normals, ne_net_norm),
        ):
            fine, coarse = asymmetries(maps, axes, dense_truth.filled)
            share = 1 / cells if norm == "mean" else 1.0
            if part in ("both", name):
                both = fine.mean(), asymmetric_loss(fine, coarse, eta=2.0, lambda_c=10.0)
                special[name] = share * torch.stack(both)
        symmetric, asymmetric = torch.stack(list(special.values())).sum(0)
    assert found.angle.item() == pytest.approx(angle.item(), abs=1e-4)
    terms = (found.on_map, found.masked, found.symmetric, found.asymmetric)
    expected = ((on_map / cells).mean(), (masked / seen).mean(), symmetric, asymmetric)
    torch.testing.assert_close(terms, expected, rtol=1e-5, atol=0)
    total = 0.7 * found.angle + 0.02 * symmetric + 1e-3 * asymmetric
    if part != "ne_net":
        total += 0.5 * (on_map if li_net_norm == "sum" else on_map / cells).mean()
        total += 0.3 * (masked if li_net_norm == "sum" else masked / seen).mean()
    assert found.total.item() == pytest.approx(total.item(), rel=1e-5)


def test_a_degree_counts_more_on_a_capture_that_is_nearly_right() -> None:
    errors = torch.tensor([math.radians(1.0), math.radians(20.0)], requires_grad=True)
    (gradient,) = torch.autograd.grad(balanced(errors), errors)
    assert (gradient[0] / gradient[1]).item() == pytest.approx(math.sqrt(22.5 / 3.5))
    typical = torch.tensor([math.radians(2.5)] * 3)
    assert balanced(typical).item() == pytest.approx(typical[0].item())
    assert balanced(typical, torch.full((3,), math.radians(7.5))).item() == pytest.approx(typical[0].item() / 2**0.5)


def test_the_angle_of_captures_is_balanced(tiny: TrainingConfig, network: SplineNet) -> None:
    pixels = replace(tiny.pixels, capture_pixels=8)
    batch = PixelGenerator(pixels, torch.Generator().manual_seed(0)).draw(32)
    with torch.no_grad():
        found = compute_losses(network, batch, replace(tiny, **SILENT | {"angle_weight": 1.0}))
        views = network.build_maps(batch.observations, batch.light_directions, batch.valid)
        normals = network.estimate(views, network.interpolate(views), captures=4).normals
        of_pixels = angles(normals, to_pixel_frame(batch.truth.normals, views))
    assert found.angle.item() == pytest.approx(of_pixels.mean().item(), rel=1e-5)
    assert found.total.item() == pytest.approx(balanced(of_pixels.view(8, 4).mean(dim=0)).item(), rel=1e-5)


@pytest.mark.parametrize("mirror", [False, True])
def test_truth_agrees_with_what_the_network_sees(tiny: TrainingConfig, mirror: bool) -> None:
    # Without a camera's faults, the true dense map at a light in a cell's centre is the sparse map there.
    network = SplineNet(tiny.network)
    batch = PixelGenerator(tiny.pixels, torch.Generator().manual_seed(0)).draw(40)
    directions, inside = cell_directions()
    lights = directions[inside][3::29]
    exposure = torch.linspace(0.3, 2, 40)[:, None]
    observations = batch.truth.radiance(lights) * exposure
    seen = PixelBatch(observations, lights, torch.ones_like(observations) > 0, batch.truth, exposure, len(exposure))
    # Without a turn beyond multiples of 90 degrees, centres stay centres.
    views = network.build_maps(observations, lights)._replace(
        cosine=torch.zeros(40), sine=torch.ones(40), mirrored=mirror
    )
    dense = dense_truth_in_frame(seen, views, size=32)
    normals = to_pixel_frame(seen.truth.normals, views)
    turned = torch.stack((-lights[:, 1], lights[:, 0], lights[:, 2]), dim=1)
    expected_normals = torch.stack((-seen.truth.normals[:, 1], *seen.truth.normals[:, [0, 2]].unbind(1)), dim=1)
    if mirror:
        turned, expected_normals = (vectors * torch.tensor((1.0, -1.0, 1.0)) for vectors in (turned, expected_normals))
    sparse = sparse_map(observations / views.scale, turned)
    assert sparse.occupied[0].sum() == len(lights)
    torch.testing.assert_close(dense.values * sparse.occupied, sparse.values.clamp(max=1), rtol=2e-3, atol=1e-4)
    torch.testing.assert_close(normals, expected_normals)
    assert dense.values.max() == 1  # highlights that no light has hit are cut
    assert torch.equal(dense.known, inside.float().expand(40, 1, 32, 32))
    assert torch.equal(dense.filled, dense.known)


def test_without_li_net_the_angle_is_all(tiny: TrainingConfig, batch: PixelBatch) -> None:
    # CNN-PS: no dense map is drawn or judged, and NE-Net learns from the angle alone.
    torch.manual_seed(0)
    network = SplineNet(NetworkConfig(size="paper", interpolates=False))
    losses = compute_losses(network, batch, preset("cnn-ps"))
    assert torch.equal(losses.total, losses.angle)
    assert all(torch.isnan(term) for term in losses[2:])
    losses.total.backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in network.parameters())
