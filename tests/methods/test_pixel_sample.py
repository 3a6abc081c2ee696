"""Samples that are spread over the appearance of pixels."""

import torch
from torch import Tensor

from splinecli.methods.distilled import draw_sample


def clusters() -> Tensor:
    """Return 5,000 features near the origin, 20 far away near (9, 0, 0), and one at (0, 30, 0)."""
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(5021, 3, generator=generator) * 0.3
    points[5000:, 0] += 9
    points[5020] = torch.tensor((0.0, 30.0, 0.0))
    return points


def test_rare_kinds_are_in_the_sample() -> None:
    sample = draw_sample(clusters(), 1200, torch.Generator().manual_seed(0))
    rows = sample.rows.tolist()
    assert len(set(rows)) == len(rows)
    assert len(rows) == 1200
    assert set(range(5000, 5021)) <= set(rows)


def test_the_first_rows_are_an_even_sample() -> None:
    """The far cluster has its share of them, 0.4 %, and not more."""
    counts = [
        int((draw_sample(clusters(), 1200, torch.Generator().manual_seed(seed)).rows[:600] >= 5000).sum())
        for seed in range(8)
    ]
    # Poisson of mean 20.1 in all: three standard deviations either way.
    assert 7 < sum(counts) < 34


def test_rare_groups_and_strangers_are_unlike() -> None:
    points = clusters()
    sample = draw_sample(points, 1200, torch.Generator().manual_seed(0), rare_share=0.005)
    unlike = sample.unlike(points)
    assert unlike[5020]
    assert unlike.float().mean() <= 0.005
    none_rare = draw_sample(points, 1200, torch.Generator().manual_seed(0))
    assert not none_rare.unlike(points).any()
    assert none_rare.unlike(torch.tensor([[0.0, 0.0, -30.0]])).all()


def test_equal_pixels_are_one_group() -> None:
    sample = draw_sample(torch.ones(500, 4), 100, torch.Generator().manual_seed(0))
    assert len(sample.rows) == 100
    assert sample.reach == 0
    assert not sample.unlike(torch.ones(3, 4)).any()
