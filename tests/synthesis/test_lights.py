"""Random rigs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from splinecli.synthesis.lights import draw_light_counts, draw_light_directions


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


def test_a_range_of_one_count() -> None:
    assert (draw_light_counts(100, 10, 10, 10, torch.Generator().manual_seed(0)) == 10).all()


def test_directions_are_unit_vectors_above_the_horizon() -> None:
    directions = draw_light_directions(2000, 30, torch.Generator().manual_seed(0))
    assert directions.shape == (2000, 30, 3)
    assert directions.norm(dim=-1).sub(1).abs().max() < 1e-6
    # Nothing lies outside 0.996 of the disc, where z = sqrt(1 - 0.996^2) = 0.0894.
    assert directions[..., 2].min() == pytest.approx(0.0894, abs=1e-3)


def test_rigs_are_ellipses_of_the_stated_axes() -> None:
    directions = draw_light_directions(1500, 1000, torch.Generator().manual_seed(0))[..., :2].double().numpy()
    centred = directions - directions.mean(axis=1, keepdims=True)
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


def test_half_of_the_rigs_lean() -> None:
    directions = draw_light_directions(2000, 1000, torch.Generator().manual_seed(1))[..., :2].double()
    offset = directions.mean(dim=1).norm(dim=1).numpy()
    # A centred rig's mean is within 0.5 / sqrt(1000) = 0.016 of the axis in each component; three times that for sure.
    # Of the leaning ones U(0, 0.35 (1 - 0.6 a)) with a in 0.34..1 takes about a quarter under it.
    assert 0.5 * 0.65 < (offset > 0.05).mean() < 0.5 * 0.85
    assert offset.max() < 0.35 * (1 - 0.6 * math.sin(math.radians(20))) + 0.05
