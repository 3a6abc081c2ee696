"""Whole evaluations: against analytic captures, hand-computed errors, and the published errors of
DiLiGenT.
"""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from scenes import (
    evaluate,
    parametrize,
    put,
    read_image,
    refuses,
    shade,
    sphere,
    spiral_lights,
    to_uint16,
    write_capture,
    write_image,
)
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.estimate.methods import Estimator, make_estimator
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.run import evaluate_all
from splinecli.evaluation.trials import TrialStore
from splinecli.maths.normals import unit
from splinecli.recipe import read_capture

LS = [make_estimator("ls")]


class Fake(Estimator):
    """Gives the folder's truth, turned by the next of the angles; remembers what it saw."""

    fingerprint = "fake"

    def __init__(self, folder, angles_deg=(0,), name="fake"):
        self.name, self.lights, self.observations = name, list[Any](), list[Any]()
        capture = read_capture(folder)
        truth = capture.ground_truth[capture.mask]
        self._truth = np.float64(truth[truth.any(axis=1)])
        self._angles = np.radians(angles_deg)

    def estimate(self, observations, lights, *, progress=None):
        angle = self._angles[len(self.lights) % len(self._angles)]
        self.lights.append(lights)
        self.observations.append(observations)
        # Perpendicular to each normal, so that turning towards it turns by the whole angle.
        across = np.cross(self._truth, [0, 1, 0])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        return np.asarray(np.cos(angle) * self._truth + np.sin(angle) * across)


class Constant(Fake):
    """Gives one vector for every pixel, whatever it sees."""

    def __init__(self, vector):
        self.name, self._vector, self.lights = "constant", vector, []

    def estimate(self, observations, lights, *, progress=None):
        self.lights.append(lights)
        return np.tile(self._vector, (len(observations), 1))


def test_mean_and_deviation_over_trials(write_dome):
    folder = write_dome()
    fake = Fake(folder, angles_deg=(1, 3, 5))
    (result,) = evaluate([folder], [fake], Protocol(n_lights=5, trials=3)).results
    assert result.maes_deg == approx((1, 3, 5), abs=1e-4)
    assert result.mae_deg == approx(3, abs=1e-4)
    assert result.std_deg == approx(np.sqrt((4 + 0 + 4) / 3), abs=1e-4)


def test_all_methods_and_captures_see_the_same_draws(write_dome):
    folders = [write_dome("a"), write_dome("b")]
    first, second = Fake(folders[0], name="first"), Fake(folders[0], name="second")
    protocol = Protocol(n_lights=4, trials=3, seed=5, light_noise_deg=3)
    evaluate(folders, [first, second], protocol)
    assert_array_equal(first.lights, second.lights)
    assert_array_equal(first.lights[:3], first.lights[3:])
    backwards = Fake(folders[0])
    evaluate(folders[::-1], [backwards], protocol)
    assert_array_equal(first.lights, backwards.lights)


def test_a_draws_file_goes_before_random_draws(write_dome, tmp_path):
    folder = write_dome()
    put(tmp_path / "draws.txt", "5 0 1\n2 3 7\n")
    fake, whole = Fake(folder), read_capture(folder)
    evaluation = evaluate([folder], [fake], Protocol(trials=99, draws_file=tmp_path / "draws.txt"))
    assert evaluation.protocol.n_lights == 3
    assert evaluation.protocol.trials == 2
    assert evaluation.results[0].n_lights == 3
    assert evaluation.results[0].trials == 2
    assert_array_equal(fake.observations[0], whole.observations[:, [5, 0, 1]])
    assert_array_equal(fake.lights[1], whole.light_directions[[2, 3, 7]])


def test_a_draws_file_that_does_not_fit_a_capture(write_dome, tmp_path):
    put(tmp_path / "draws.txt", "0 1 2\n0 1 9\n")
    folders = [write_dome("eight"), write_dome("ten", n_lights=10)]
    evaluation = evaluate(folders, LS, Protocol(draws_file=tmp_path / "draws.txt"))
    assert evaluation.captures == ("ten",)
    problem = (
        f"{tmp_path}/draws.txt:2: found light index 9, expected 0 to 7, because the capture has 8"
        " lights."
    )
    assert [(s.capture, s.reason) for s in evaluation.skipped] == [("eight", problem)]


def test_light_noise_costs_least_squares_its_exactness(write_dome):
    folder = write_dome()
    errors = [
        evaluate([folder], LS, Protocol(trials=20, light_noise_deg=sigma)).results[0]
        for sigma in (0, 1, 4)
    ]
    # all lights, other noise in each trial
    assert [result.trials for result in errors] == [1, 20, 20]
    assert len(set(errors[1].maes_deg)) == 20
    assert errors[0].mae_deg < 0.02 < 0.2 < errors[1].mae_deg
    # The trials' noise is the same but for its size, and small errors grow in proportion.
    assert errors[2].mae_deg == approx(4 * errors[1].mae_deg, rel=0.1)


@parametrize("shift", [0, 6])
def test_a_shifted_ground_truth_under_lamps_of_unequal_brightness(tmp_path, shift):
    """Lamps are darker the further they are from the camera axis, and no file lists their
    intensities.
    """
    (normals, mask), lights = sphere(48), spiral_lights(20, 50, 15)
    images = 400 * np.exp(5 * lights[:, 2]) * shade(normals, lights) * mask[..., None]
    folder = write_capture(
        tmp_path / "ball",
        to_uint16(np.moveaxis(images, 2, 0)),
        lights,
        mask=mask,
        normals=np.roll(np.where(mask[..., None], normals, 0), shift, 1),
    )
    notes = [n for n in evaluate([folder], LS, Protocol()).notes if "ground truth is" in n]
    assert len(notes) == (shift > 0)
    assert all("once a shift of 6 pixels right is undone" in note for note in notes)


def test_the_ground_truth_of_a_real_ball_under_unequal_lamps(shared_data, tmp_path):
    """If the lamps are assumed to be equal, it seems to be shifted by 27 pixels."""
    folder = tmp_path / "ball"
    shutil.copytree(
        shared_data / "DiLiGenT/pmsData/ballPNG",
        folder,
        ignore=shutil.ignore_patterns("light_intensities.txt"),
    )
    notes = evaluate([folder], LS, Protocol(10, trials=6)).notes
    assert not [note for note in notes if "ground truth is" in note]


def test_captures_that_cannot_be_scored_are_skipped(write_dome, tmp_path):
    good, untrue, few = (
        write_dome("good"),
        write_dome("untrue", ground_truth=False),
        write_dome("few", n_lights=4),
    )
    broken = write_dome("broken")
    (broken / "003.png").write_bytes(b"no image")
    folders = [untrue, good, broken, few, tmp_path / "missing"]
    evaluation = evaluate(folders, LS, Protocol(n_lights=5, trials=10))
    assert evaluation.captures == ("good",)
    assert [skipped.capture for skipped in evaluation.skipped] == [
        "untrue",
        "broken",
        "few",
        "missing",
    ]
    reasons = [skipped.reason for skipped in evaluation.skipped]
    assert reasons[0].startswith(f"{untrue}: the capture has no ground truth.")
    assert str(broken / "003.png") in reasons[1]
    assert (
        reasons[2]
        == "the capture has only 4 lights, but --n-lights is 5. Use --n-lights 4, or fewer."
    )
    assert str(tmp_path / "missing") in reasons[3]


def test_nothing_scored_is_an_error(write_dome, tmp_path):
    untrue, few = write_dome("untrue", ground_truth=False), write_dome("few", n_lights=4)
    none = (
        "none of the 2 captures could be scored; the first error is: .*untrue: the capture has no"
        " ground truth"
    )
    for folders, error, message in (
        ([untrue, few], InputError, none),
        ([untrue], InputError, "untrue: the capture has no ground truth"),
        ([few], UsageError, "the capture has only 4 lights, but --n-lights is 5"),
    ):
        with refuses(message, error):
            evaluate(folders, LS, Protocol(n_lights=5))


def test_names_tell_captures_apart(write_dome, monkeypatch):
    folders = [write_dome("few/dome", n_lights=4), write_dome("many/dome"), write_dome("many/bowl")]
    assert evaluate(folders, LS, Protocol()).captures == ("few/dome", "many/dome", "many/bowl")
    monkeypatch.chdir(folders[1])
    assert evaluate([Path(), folders[1], folders[2]], LS, Protocol()).captures == ("dome", "bowl")


@parametrize("vector", [(0, 0, 0), (0, 0, np.nan), (0, 0, 0.5)])
def test_normals_that_are_none_are_not_scored(write_dome, vector):
    with refuses("method constant gave normals that are not unit vectors", SplinecliError):
        evaluate([write_dome()], [Constant(vector)], Protocol())


def test_progress(write_dome):
    folders = [write_dome("a"), write_dome("b")]
    seen = []
    protocols = [Protocol(n_lights=7, trials=2), Protocol()]
    evaluate_all(folders, LS, protocols, on_progress=lambda share, note: seen.append((share, note)))
    shares, notes = zip(*seen, strict=True)
    assert min(shares) == 0
    assert sum(shares) == approx(1)
    assert [note for note in notes if "reading b" in note] == [
        f"reading b, image {i} of 8" for i in range(1, 9)
    ]
    assert notes[-1] == "trial 6 of 6"


def test_trials_at_a_time_change_nothing(write_dome):
    folders = [write_dome("a"), write_dome("b", n_lights=9)]
    estimators = [make_estimator("ls"), make_estimator("iw12")]
    protocols = [Protocol(4, trials=5, light_noise_deg=noise) for noise in (0, 3)]
    one_by_one = evaluate_all(folders, estimators, protocols)
    together = evaluate_all(folders, estimators, protocols, jobs=3)
    for before, after in zip(one_by_one, together, strict=True):
        assert [(r.method, r.capture) for r in before.results] == [
            (r.method, r.capture) for r in after.results
        ]
        assert_allclose(
            [r.maes_deg for r in after.results], [r.maes_deg for r in before.results], atol=1e-5
        )


def test_one_that_was_cut_off_goes_on(write_dome, tmp_path):
    folder, path = write_dome(), tmp_path / "trials.jsonl"

    def scored(angles_deg, trials, **options):
        fake, store = Fake(folder, angles_deg), TrialStore(path, **options)
        return evaluate_all([folder], [fake], [Protocol(4, trials=trials)], store=store)[0], fake

    scored((1, 2), 2)
    lines = path.read_text().splitlines(keepends=True)
    # Killed while it wrote the second line.
    put(path, lines[0] + lines[1][: len(lines[1]) // 2])
    evaluation, again = scored((5, 6, 7), 4)
    assert evaluation.results[0].maes_deg == approx((1, 5, 6, 7), abs=1e-4)
    assert len(again.lights) == 3
    # Nothing is left to do, and nothing of the first run's was lost.
    same, idle = scored((90,), 4)
    assert same == evaluation
    assert idle.lights == []
    fresh, _ = scored((90,), 4, fresh=True)
    assert fresh.results[0].mae_deg == approx(90, abs=1e-4)
    assert len(path.read_text().splitlines()) == 4


@parametrize(
    "change",
    "photograph lights method seed max_pixels light_noise_deg n_lights as_stored",
)
def test_a_trial_of_something_else_does_not_count(write_dome, tmp_path, change):
    folder, path = write_dome(), tmp_path / "trials.jsonl"
    settings = {"n_lights": 4, "max_pixels": 50, "light_noise_deg": 1.0}
    fake = Constant((0, 0, 1))
    evaluate_all([folder], [fake], [Protocol(**settings)], store=TrialStore(path))
    fake.lights.clear()
    if change == "photograph":
        write_image(folder / "003.png", read_image(folder / "003.png")[::-1].copy())
    elif change == "lights":
        lights = folder / "light_directions.txt"
        put(lights, lights.read_text() + "\n")
    elif change == "method":
        fake.fingerprint = "other weights"
    else:
        settings[change] = True if change == "as_stored" else 5
    evaluate_all([folder], [fake], [Protocol(**settings)], store=TrialStore(path))
    assert fake.lights


def test_captures_with_equal_stamps_are_not_taken_for_each_other(write_dome):
    """As out of an archive whose times were normalised: names, sizes and times of all files are the
    same.
    """
    folders = [write_dome("u/dome"), write_dome("v/dome")]
    for folder in folders:
        for path in folder.iterdir():
            content = path.read_bytes()
            if folder is folders[1] and path.suffix == ".npy":
                half = (len(content) - 128) // 2  # after the header of 128 bytes
                path.write_bytes(content[:128] + content[128 + half :] + content[128 : 128 + half])
            os.utime(path, ns=(10**18, 10**18))
    sizes = [
        sorted((path.name, path.stat().st_size) for path in folder.iterdir()) for folder in folders
    ]
    assert sizes[0] == sizes[1]
    first, second = evaluate(folders, LS, Protocol()).results
    assert first.mae_deg < 0.1 < second.mae_deg


def test_noise_that_lays_lights_into_a_plane_is_drawn_again(write_dome, monkeypatch):
    sigmas = []

    def tilt(lights, sigma_deg, *_):
        sigmas.append(sigma_deg)
        return unit(lights * (1, 0, 1)) if len(sigmas) == 1 else lights

    monkeypatch.setattr("splinecli.evaluation.trials.tilt_lights", tilt)
    protocol = Protocol(3, trials=1, light_noise_deg=30.0)
    assert evaluate([write_dome()], LS, protocol).results[0].mae_deg < 0.02
    assert sigmas == [30, 30]


def test_first_images_are_left_out(write_dome):
    folders = [write_dome("bearPNG"), write_dome("other")]
    fake = Fake(folders[0])
    evaluation = evaluate(folders, [fake], Protocol(skip_first={"bearPNG": 3}))
    assert [len(lights) for lights in fake.lights] == [5, 8]
    assert_array_equal(fake.observations[0], read_capture(folders[0]).observations[:, 3:])
    assert [result.n_lights for result in evaluation.results] == [5, 8]
    assert evaluation.notes == ("bearPNG: the first 3 images were left out.",)
    every = Fake(folders[0])
    evaluate(folders, [every], Protocol(skip_first={"*": 4, "other": 1}))
    assert [len(lights) for lights in every.lights] == [4, 7]


def test_draws_keep_to_the_images_that_are_not_left_out(write_dome, tmp_path):
    folder = write_dome(n_lights=9)
    fake = Fake(folder)
    evaluate([folder], [fake], Protocol(4, trials=20, skip_first={"*": 3}))
    lights = read_capture(folder).light_directions
    seen = {tuple(light) for draw in fake.lights for light in draw}
    assert seen == {tuple(light) for light in lights[3:]}
    put(tmp_path / "draws.txt", "3 4 5\n2 4 5\n")
    with refuses(r"draws\.txt:2: found light index 2, but the first 3"):
        evaluate([folder], [fake], Protocol(draws_file=tmp_path / "draws.txt", skip_first={"*": 3}))
