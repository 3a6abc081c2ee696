"""Draws of lights: what they depend on, every complaint about a draws file, and the white level of
each draw.
"""

import numpy as np
import pytest
from numpy.random import default_rng

from scenes import (
    cap_directions,
    evaluate,
    parametrize,
    put,
    refuses,
    shade,
    sphere_cap,
    spiral_lights,
    vectors,
    write_capture,
)
from splinecli.capture import open_capture
from splinecli.errors import InputError, UsageError
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.evaluation.protocol import Protocol, read_draws
from splinecli.evaluation.run import evaluate_all
from splinecli.evaluation.trials import TrialStore
from splinecli.lights.draws import draw_lights
from splinecli.maths.normals import unit
from splinecli.recipe import prepare_capture
from splinecli.recipe.steps import begin, follow
from splinecli.recipe.work import RecipeOptions
from splinecli.records.white_level import WhiteLevel

LIGHTS = cap_directions(96, 75)


def test_draws_are_those_of_earlier_versions():
    """Published numbers name a seed: the draws behind it stay."""
    assert draw_lights(LIGHTS, 10, trials=2, seed=0) == [
        (10, 25, 40, 41, 50, 61, 74, 76, 87, 90),
        (20, 24, 25, 30, 33, 42, 53, 59, 75, 93),
    ]


@parametrize("n_lights", [None, 96])
def test_all_lights_are_one_draw(n_lights):
    assert draw_lights(LIGHTS, n_lights, trials=100, seed=3) == [tuple(range(96))]


def test_lights_in_one_plane_are_drawn_again():
    """Of five lights the first four lie in the plane y = 0: a draw of three needs the fifth."""
    flat = unit(vectors("-0.5 0 1; 0.2 0 1; 0.5 0 1; 0.9 0 1; 0 0.5 1"))
    draws = draw_lights(flat, 3, trials=100, seed=0)
    assert all(4 in draw for draw in draws)
    assert len(set(draws)) == 6  # all pairs of the four
    general = draw_lights(cap_directions(5, 75), 3, trials=100, seed=0)
    assert all(ours == theirs for ours, theirs in zip(draws, general, strict=True) if 4 in theirs)
    assert draws[:10] == draw_lights(flat, 3, trials=10, seed=0)


@parametrize("name, value", [("trials", 0), ("seed", -1)])
def test_what_cannot_be_drawn(name, value):
    with refuses(f"--{name} is {value}; expected", UsageError):
        draw_lights(LIGHTS, n_lights=10, **{name: value})


def test_a_draws_file(tmp_path):
    file = read_draws(
        put(tmp_path / "draws.txt", "# ours\n0 3 5\n\n 95,1,  2  # in any order\n7\t8;9")
    )
    assert file.draws == ((0, 3, 5), (95, 1, 2), (7, 8, 9))
    assert file.lines == (2, 4, 5)
    assert file.n_lights == 3
    file.check_against(LIGHTS)


def test_a_long_draw_is_read(tmp_path):
    path = put(tmp_path / "draws.txt", " ".join(map(str, range(40_000))))
    assert read_draws(path).n_lights == 40_000


@parametrize(
    "text, problem",
    r"""
0 1 2\n0 x 2 | :2: found "x", expected a light index from 0.
0 1 2\n\n0 -1 2 | :3: found "-1", expected a light index from 0.
0 1.5 2 | :1: found "1.5", expected a light index from 0.
0 1 9999999999 | :1: found "9999999999", expected a light index from 0.
0 1 2\n4 5 4 | :2: light index 4 is listed twice. List each light once.
# two\n0 1 | :2: found 2 light indices, expected at least 3.
0 1 2\n0 1 2 3 | :2: found 4 light indices, expected 3 as in the first draw.
# nothing\n | : the file contains no draws, expected one line of light indices for each.
""",
)
def test_a_wrong_draws_file(tmp_path, text, problem):
    path = put(tmp_path / "draws.txt", text)
    with pytest.raises(InputError) as raised:
        read_draws(path)
    assert str(raised.value) == f"{path}{problem}"


SIDE, N_LIGHTS, CLIPPED, LEVEL = 48, 9, 3, 6000
LS = make_estimator("ls")


@pytest.fixture
def folder(tmp_path):
    """A matte sphere under nine lights. The camera clips three images at 6000; the others are too
    dark for that.
    """
    normals, lights = sphere_cap(SIDE), spiral_lights(N_LIGHTS, 50)
    rng = default_rng(3)
    albedo = rng.uniform(0.6, 1, (SIDE, SIDE, 1))
    intensities = np.where(np.arange(N_LIGHTS) < CLIPPED, 1.6, 0.5)
    values = (
        intensities
        * LEVEL
        * albedo
        * shade(normals, lights)
        * rng.normal(1, 0.01, (SIDE, SIDE, N_LIGHTS))
    )
    images = np.moveaxis(np.uint16(np.minimum(np.rint(values), LEVEL)), 2, 0)
    assert ((images == LEVEL).any(axis=(1, 2)) == (np.arange(N_LIGHTS) < CLIPPED)).all()
    colours = np.repeat(intensities[:, None], 3, axis=1)
    return write_capture(tmp_path / "half", images, lights, normals=normals, intensities=colours)


def mae_deg(folder, lights, **settings):
    """The error of a capture under these lights, read without any other image."""
    return estimate_normals(
        prepare_capture(open_capture(folder), lights, RecipeOptions(**settings)), LS
    ).errors.mean


def test_each_trial_scores_what_infer_computes_from_its_lights(folder):
    draws = draw_lights(open_capture(folder).light_directions, 5, trials=12, seed=1)
    levels = {draw: prepare_capture(open_capture(folder), draw).white_level for draw in draws}
    assert set(levels.values()) == {WhiteLevel(LEVEL, "images"), WhiteLevel(65_535, "full scale")}
    (result,) = evaluate([folder], [LS], Protocol(5, trials=12, seed=1)).results
    assert result.maes_deg == pytest.approx([mae_deg(folder, draw) for draw in draws], abs=1e-6)
    assert any(abs(mae_deg(folder, d) - mae_deg(folder, d, as_stored=True)) > 0.1 for d in draws)


@parametrize("max_pixels", [None, 200])
def test_the_number_of_trials_does_not_change_a_trial(folder, max_pixels):
    def maes_deg(trials, store):
        protocol = Protocol(5, trials=trials, seed=1, max_pixels=max_pixels)
        ((result,),) = (e.results for e in evaluate_all([folder], [LS], [protocol], store=store))
        return result.maes_deg

    store = TrialStore()
    few = maes_deg(1, store) + maes_deg(4, store)[1:] + maes_deg(12, store)[4:]
    assert few == pytest.approx(maes_deg(12, TrialStore()), abs=1e-6)


def observed(folder, lights=None):
    return follow(begin(open_capture(folder), lights), until="lights")


def test_a_part_of_the_images_and_pixels_keeps_the_level_of_its_images(folder):
    stored = observed(folder)
    assert stored.made.white_level == WhiteLevel(LEVEL, "images")
    dim = stored.choose_images([1, 4, 5, 6, 8])
    assert dim.made.white_level == WhiteLevel(65_535, "full scale")
    assert dim.saturated.flags is None
    rows = np.arange(0, SIDE * SIDE, 7)
    bright = stored.choose_images([2, 4, 0, 1]).choose_pixels(rows).choose_pixels(np.arange(5, 300))
    alone = observed(folder, [2, 4, 0, 1])
    assert bright.made.white_level == alone.made.white_level == WhiteLevel(LEVEL, "images")
    assert bright.saturated.flags.any()
    np.testing.assert_array_equal(bright.saturated.flags, alone.saturated.flags[rows][5:300])
