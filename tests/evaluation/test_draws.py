"""Draws of lights: what they depend on, and the text of every complaint about a draws file."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splinecli.errors import InputError, UsageError
from splinecli.evaluation.protocol import draw_lights, read_draws
from splinecli.maths.normals import unit


def random_lights(n_lights: int, seed: int = 0) -> np.ndarray:
    lights = np.random.default_rng(seed).normal(size=(n_lights, 3))
    lights[:, 2] = np.abs(lights[:, 2]) + 0.2
    return unit(lights)


LIGHTS = random_lights(96)


def test_draws_are_those_of_earlier_versions() -> None:
    """Published numbers name a seed: the draws behind it stay."""
    assert draw_lights(LIGHTS, 10, trials=2, seed=0) == [
        (10, 25, 40, 41, 50, 61, 74, 76, 87, 90),
        (20, 24, 25, 30, 33, 42, 53, 59, 75, 93),
    ]


@given(n_lights=st.integers(4, 95), seed=st.integers(0, 2**40))
def test_a_draw_is_rising_distinct_indices(n_lights: int, seed: int) -> None:
    (draw,) = draw_lights(LIGHTS, n_lights, seed=seed)
    assert len(draw) == n_lights
    assert list(draw) == sorted(set(draw))
    assert set(draw) <= set(range(96))
    assert all(type(index) is int for index in draw)


def test_more_trials_continue_the_list() -> None:
    assert draw_lights(LIGHTS, 10, trials=30, seed=4)[:7] == draw_lights(LIGHTS, 10, trials=7, seed=4)


def test_every_light_is_equally_likely() -> None:
    trials, share = 2000, 10 / 96
    counts = np.bincount(np.ravel(draw_lights(LIGHTS, 10, trials=trials, seed=0)), minlength=96)
    # Each count is binomial; the largest of 96 deviations beyond 4.5 standard deviations has a chance of 0.07 %.
    assert np.abs(counts - trials * share).max() < 4.5 * np.sqrt(trials * share * (1 - share))


@pytest.mark.parametrize("n_lights", [None, 96])
def test_all_lights_are_one_draw(n_lights: int | None) -> None:
    assert draw_lights(LIGHTS, n_lights, trials=100, seed=3) == [tuple(range(96))]


def test_lights_in_one_plane_are_drawn_again() -> None:
    """Of five lights the first four lie in the plane y = 0: a draw of three needs the fifth."""
    flat = unit(np.array([[-0.5, 0, 1], [0.2, 0, 1], [0.5, 0, 1], [0.9, 0, 1], [0, 0.5, 1]]))
    draws = draw_lights(flat, 3, trials=100, seed=0)
    assert all(4 in draw for draw in draws)
    assert len(set(draws)) == 6  # all pairs of the four
    general = draw_lights(random_lights(5), 3, trials=100, seed=0)
    assert all(ours == theirs for ours, theirs in zip(draws, general, strict=True) if 4 in theirs)
    assert draws[:10] == draw_lights(flat, 3, trials=10, seed=0)


@pytest.mark.parametrize(("name", "value"), [("trials", 0), ("seed", -1)])
def test_what_cannot_be_drawn(name: str, value: int) -> None:
    with pytest.raises(UsageError, match=f"--{name} is {value}; expected"):
        draw_lights(LIGHTS, n_lights=10, **{name: value})


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "draws.txt"
    path.write_text(text)
    return path


def test_a_draws_file(tmp_path: Path) -> None:
    file = read_draws(write(tmp_path, "# ours\n0 3 5\n\n 95,1,  2  # in any order\n7\t8;9"))
    assert (file.draws, file.lines, file.n_lights) == (((0, 3, 5), (95, 1, 2), (7, 8, 9)), (2, 4, 5), 3)
    file.check_against(LIGHTS)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0 1 2\n0 x 2", ':2: found "x", expected a light index from 0.'),
        ("0 1 2\n\n0 -1 2", ':3: found "-1", expected a light index from 0.'),
        ("0 1.5 2", ':1: found "1.5", expected a light index from 0.'),
        ("0 1 9999999999", ':1: found "9999999999", expected a light index from 0.'),
        ("0 1 2\n4 5 4", ":2: light index 4 is listed twice. Name each light once."),
        ("# two\n0 1", ":2: found 2 light indices, expected at least 3."),
        ("0 1 2\n0 1 2 3", ":2: found 4 light indices, expected 3 as in the first draw."),
        ("# nothing\n", ": the file contains no draws, expected a line of light indices for each."),
    ],
)
def test_a_wrong_draws_file(tmp_path: Path, text: str, problem: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as raised:
        read_draws(path)
    assert str(raised.value) == f"{path}{problem}"
