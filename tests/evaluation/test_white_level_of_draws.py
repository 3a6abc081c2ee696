"""The white level of each draw comes from its own images, as in `infer`, whatever other trials are read with it."""

from pathlib import Path

import numpy as np
import pytest

from scenes import evaluate, shade, sphere_cap, spiral_lights, write_capture
from splinecli.capture import open_capture
from splinecli.evaluation.protocol import Protocol, draw_lights
from splinecli.evaluation.run import evaluate_all
from splinecli.evaluation.trials import TrialStore
from splinecli.inference import estimate_normals
from splinecli.methods import make_estimator
from splinecli.restoration.images import WhiteLevel

SIDE, N_LIGHTS, CLIPPED, LEVEL = 48, 9, 3, 6000
LS = make_estimator("ls")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A matte sphere under nine lights. The camera clips three images at 6000; the others are too dark for that."""
    normals, lights = sphere_cap(SIDE), spiral_lights(N_LIGHTS, 50)
    rng = np.random.default_rng(3)
    albedo = rng.uniform(0.6, 1, (SIDE, SIDE, 1))
    intensities = np.where(np.arange(N_LIGHTS) < CLIPPED, 1.6, 0.5)
    values = intensities * LEVEL * albedo * shade(normals, lights) * rng.normal(1, 0.01, (SIDE, SIDE, N_LIGHTS))
    images = np.moveaxis(np.minimum(np.rint(values), LEVEL).astype(np.uint16), 2, 0)
    assert ((images == LEVEL).any(axis=(1, 2)) == (np.arange(N_LIGHTS) < CLIPPED)).all()
    colours = np.repeat(intensities[:, None], 3, axis=1)
    return write_capture(tmp_path / "half", images, lights, normals=normals, intensities=colours)


def mae_deg(folder: Path, lights: tuple[int, ...], **settings: bool) -> float:
    """The error of a capture under these lights, read without any other image."""
    return estimate_normals(open_capture(folder).read(lights, **settings), LS).errors.mean


def test_each_trial_scores_what_infer_computes_from_its_lights(folder: Path) -> None:
    draws = draw_lights(open_capture(folder).light_directions, 5, trials=12, seed=1)
    levels = {draw: open_capture(folder).read(draw).white_level for draw in draws}
    assert set(levels.values()) == {WhiteLevel(LEVEL, "images"), WhiteLevel(65_535, "full scale")}
    (result,) = evaluate([folder], [LS], Protocol(5, trials=12, seed=1)).results
    assert result.maes_deg == pytest.approx([mae_deg(folder, draw) for draw in draws], abs=1e-6)
    assert any(abs(mae_deg(folder, d) - mae_deg(folder, d, as_stored=True)) > 0.1 for d in draws)


@pytest.mark.parametrize("max_pixels", [None, 200])
def test_the_number_of_trials_does_not_change_a_trial(folder: Path, max_pixels: int | None) -> None:
    def maes_deg(trials: int, store: TrialStore) -> tuple[float, ...]:
        protocol = Protocol(5, trials=trials, seed=1, max_pixels=max_pixels)
        ((result,),) = (e.results for e in evaluate_all([folder], [LS], [protocol], store=store))
        return result.maes_deg

    store = TrialStore()
    few = maes_deg(1, store) + maes_deg(4, store)[1:] + maes_deg(12, store)[4:]
    assert few == pytest.approx(maes_deg(12, TrialStore()), abs=1e-6)


def test_a_part_of_the_images_and_pixels_keeps_the_level_of_its_images(folder: Path) -> None:
    stored = open_capture(folder).read_stored()
    assert stored.capture.white_level == WhiteLevel(LEVEL, "images")
    dim = stored.choose_lights([1, 4, 5, 6, 8])
    assert (dim.capture.white_level, dim.saturation.flags) == (WhiteLevel(65_535, "full scale"), None)
    rows = np.arange(0, SIDE * SIDE, 7)
    bright = stored.choose_lights([2, 4, 0, 1]).choose_pixels(rows).choose_pixels(np.arange(5, 300))
    alone = open_capture(folder).read_stored([2, 4, 0, 1])
    assert bright.capture.white_level == alone.capture.white_level == WhiteLevel(LEVEL, "images")
    assert bright.saturation.flags.any()
    np.testing.assert_array_equal(bright.saturation.flags, alone.saturation.flags[rows][5:300])
