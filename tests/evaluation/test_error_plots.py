"""Plots decode, have the size their panels need, and carry each method's colour."""

import numpy as np

from evaluation.conftest import evaluation_of
from scenes import decode_rgb, parametrize
from splinecli.evaluation.figures import light_noise_curves, lights_curves
from splinecli.evaluation.protocol import Evaluation, Protocol, Result
from splinecli.pictures.plots import method_styles

METHODS = ("ls", "spline-net")


def evaluated(captures, n_lights=10, light_noise_deg=0.0):
    level = 20 / (n_lights or 96) + light_noise_deg
    maes_deg = {
        method: [m + level + more for more in (0, 0.5, 1)] for m, method in enumerate(METHODS, 3)
    }
    return evaluation_of(
        dict.fromkeys(captures, maes_deg), n_lights, light_noise_deg=light_noise_deg
    )


def share_of(colour, picture):
    rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return float((np.abs(picture.astype(int) - rgb).max(axis=2) <= 2).mean())


@parametrize(
    "captures, across, down",
    [
        (["ball"], 1, 1),
        (["ball", "cat"], 3, 1),
        (list("abc"), 2, 2),
        (list("abcd"), 3, 2),
        (list("abcde"), 1, 1),
    ],
)
def test_a_panel_for_each_capture_and_the_average(captures, across, down):
    picture = decode_rgb(lights_curves([evaluated(captures, k) for k in (4, 10, None)]))
    assert picture.shape == (540 * down + 80, 640 * across, 3) and (picture[0] == 255).all()


def test_each_method_has_its_colour_in_both_plots():
    styles = method_styles(METHODS)
    for png in (
        lights_curves([evaluated(["ball"], k) for k in (4, 10, 32)]),
        light_noise_curves([evaluated(["ball"], 10, noise) for noise in (0, 2, 4)]),
    ):
        for method in METHODS:
            assert share_of(styles[method].colour, decode_rgb(png)) > 0.002  # a line 3 pixels thick


def test_captures_that_not_all_have_are_left_out():
    fewer = evaluated(["ball"], 50)
    both = evaluated(["ball", "cat"], 10)
    assert lights_curves([both, fewer]) == lights_curves([evaluated(["ball"], 10), fewer])


def test_odd_names_one_point_and_one_trial_are_drawn():
    odd = Evaluation(Protocol(10), (Result("_m$x$", "a$b_{c$ 猫", 10, (3.0,), 1.0),))
    # matplotlib takes what stands between dollars for a formula, and raises for this one.
    for draw in (lights_curves, light_noise_curves):
        assert (decode_rgb(draw([odd])) < 128).any()
