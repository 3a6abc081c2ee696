"""Random rigs."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats

from splinecli.synthesis.lights import RIG_SHARES, draw_light_counts, draw_light_directions


def draw_rigs(kind: str, pixels: int, lights: int) -> NDArray[np.float64]:
    random = torch.Generator().manual_seed(0)
    return draw_light_directions(pixels, lights, random, {kind: 1.0}).double().numpy()


def centred_rigs(kind: str, pixels: int, lights: int) -> NDArray[np.float64]:
    points = draw_rigs(kind, pixels, lights)[..., :2]
    return points - points.mean(axis=1, keepdims=True)


def test_half_of_the_draws_have_about_the_usual_number() -> None:
    random = torch.Generator().manual_seed(0)
    draws = [draw_light_counts(50, 4, 96, 10, random).numpy() for _ in range(4000)]
    largest = np.array([counts.max() for counts in draws])
    assert largest.min() >= 4
    assert largest.max() >= 90

    def log_uniform(most: int) -> float:
        return math.log((most + 1) / 4) / math.log(97 / 4)

    # Four standard deviations of a share of 4000 are at most 0.03.
    for most in (7, 20, 50):
        expected = 0.5 * log_uniform(most) + 0.5 * (most >= 12)
        assert (largest <= most).mean() == pytest.approx(expected, abs=0.035)
    assert all(counts.min() >= np.floor(0.8 * counts.max()) for counts in draws)


def test_directions_are_unit_vectors_above_the_horizon() -> None:
    directions = draw_light_directions(2000, 30, torch.Generator().manual_seed(0))
    assert directions.shape == (2000, 30, 3) and directions.norm(dim=-1).sub(1).abs().max() < 1e-6
    # Nothing lies outside 0.996 of the disc, where z = sqrt(1 - 0.996^2) = 0.0894.
    assert directions[..., 2].min() == pytest.approx(0.0894, abs=1e-3)


def test_rigs_are_ellipses_of_the_stated_axes() -> None:
    centred = centred_rigs("ellipse", 1500, 1000)
    # A uniform ellipse has variances of a quarter of its half-axes squared.
    axes = 2 * np.sqrt(np.linalg.eigvalsh(np.einsum("pfi,pfj->pij", centred, centred) / 1000))
    small = axes[:, 1] < math.sin(math.radians(40))  # no rig this small is cut by the rim
    assert small.sum() > 300
    # sin U(20, 88) degrees, seen through an estimate of some per cent: 20 is blurred.
    largest_deg = np.degrees(np.arcsin(axes[small, 1]))
    assert largest_deg.min() > 18.5
    assert stats.kstest(largest_deg, stats.uniform(20, 20).cdf).pvalue > 1e-3
    assert small.mean() == pytest.approx(20 / 68, abs=0.05)
    assert stats.kstest(axes[small, 0] / axes[small, 1], stats.uniform(0.5, 0.5).cdf).statistic < 0.07


def test_cones_are_narrow() -> None:
    centred = centred_rigs("cone", 500, 400)
    radius_deg = np.degrees(np.arcsin(np.linalg.norm(centred, axis=2).max(axis=1)))
    # The mean of 400 lights is off by some hundredths of the radius.
    assert stats.kstest(radius_deg, stats.uniform(8, 12).cdf).statistic < 0.15
    assert radius_deg.max() < 22


def test_rings_have_one_elevation() -> None:
    directions = draw_rigs("ring", 500, 200)
    polar_deg = np.degrees(np.arccos(directions[..., 2]))
    assert stats.kstest(polar_deg.mean(axis=1), stats.uniform(15, 60).cdf).statistic < 0.08
    assert np.median(polar_deg.std(axis=1)) == pytest.approx(2, abs=0.15)
    # The mean direction of a whole ring is the view axis. An arc of A has sin(A / 2) / (A / 2) of a ring's radius.
    off_axis = np.linalg.norm(directions[..., :2].mean(axis=1), axis=1) / np.sin(np.radians(polar_deg.mean(axis=1)))
    assert 0.4 < (off_axis < 0.03).mean() < 0.6
    assert off_axis.max() < math.sin(math.radians(60)) / math.radians(60) + 0.05


def test_lines_lie_nearly_in_a_plane() -> None:
    centred = centred_rigs("line", 500, 400)
    across = np.sqrt(np.linalg.eigvalsh(np.einsum("pfi,pfj->pij", centred, centred) / 400)[:, 0])
    assert stats.kstest(np.degrees(np.arcsin(across)), stats.uniform(1, 9).cdf).statistic < 0.1


def test_hand_held_lights_come_in_clusters() -> None:
    directions = draw_rigs("hand-held", 500, 12)
    angles = np.degrees(np.arccos(np.clip(directions @ directions.transpose(0, 2, 1), -1, 1)))
    angles += 360 * np.eye(12)
    polar_deg = np.degrees(np.arccos(directions[..., 2]))
    assert polar_deg.min() > 20 - 24 and np.median(polar_deg) == pytest.approx(45, abs=3)
    # Three of four rigs have at least two lights a cluster, which are 6 sqrt(2) degrees apart on average, or closer
    # where a turn about the axis moves them less.
    assert (np.median(angles.min(axis=2), axis=1) < 12).mean() > 0.6


def test_all_kinds_of_rigs_are_drawn() -> None:
    directions = draw_light_directions(4000, 40, torch.Generator().manual_seed(0))
    polar_spread_deg = torch.rad2deg(directions[..., 2].acos()).std(dim=1)
    rings = (polar_spread_deg < 3).double().mean().item()
    # Cones about the view axis are as even.
    assert RIG_SHARES["ring"] * 0.8 < rings < (RIG_SHARES["ring"] + RIG_SHARES["cone"]) * 1.1
    assert sum(RIG_SHARES.values()) == pytest.approx(1)
