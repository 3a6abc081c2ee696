"""Distilled estimators, taught by estimators whose answers and mistakes are known."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from pytest import approx

from distributions import seeded
from scenes import Teacher, cap_directions, parametrize, refuses, shade, spiral_lights
from splinecli.errors import UsageError
from splinecli.estimate.methods.distilled import DistilledEstimator, distil, draw_sample
from splinecli.estimate.methods.estimator import (
    UNKNOWN_ERROR,
    LeastSquares,
    StudentSize,
    confident_share,
    student_sizes,
)
from splinecli.lights.lighting import PixelLighting
from splinecli.maths.normals import angle_between_deg, unit

Floats = NDArray[np.floating]
LIGHTS = spiral_lights(8, 50)
SIZE = StudentSize(sample=1600, steps=160, width=64)
SMALL = StudentSize(sample=800, steps=80, width=32)


@dataclass
class Remembering(Teacher):
    """Knows the normal and the error of each pixel by heart."""

    observations: NDArray[np.float32]
    normals: Floats
    errors: Floats
    places: dict[bytes, int] = field(default_factory=dict)

    def __post_init__(self):
        self.places = {row.tobytes(): place for place, row in enumerate(self.observations)}

    def estimate_with_error(self, observations, light_directions, *, progress=None):
        assert light_directions.shape in (LIGHTS.shape, (len(observations), *LIGHTS.shape))
        self.asked += len(observations)
        if progress is not None:
            progress(len(observations))
        places = [self.places[row.tobytes()] for row in observations]
        return self.normals[places], self.errors[places]


def log_median(degrees):
    return math.log(math.radians(degrees)), math.log(2)


def noisy(normals, degrees, seed=5):
    """Return normals turned by about so many degrees."""
    noise = (
        default_rng(seed).normal(size=normals.shape)
        * math.radians(degrees)
        / math.sqrt(math.pi / 2)
    )
    return unit(normals + noise - normals * (normals * noise).sum(axis=1, keepdims=True))


def glossy(count=8000):
    normals = cap_directions(count, 50)
    return normals, shade(normals, LIGHTS, gloss=0.8).astype(np.float32)


def distant(observations):
    return lambda rows: PixelLighting(observations[rows], LIGHTS)


def learn(teacher, size=SIZE, **options):
    return distil(
        teacher, distant(teacher.observations), len(teacher.observations), size, **options
    )


def sure(observations, normals, degrees=2):
    """A teacher who expects the same error everywhere."""
    return Remembering(observations, normals, np.tile(log_median(degrees), (len(normals), 1)))


def test_it_follows_the_truth_through_the_noise_of_its_teacher():
    normals, observations = glossy()
    teacher = sure(observations, noisy(normals, 4), 4)
    found = learn(teacher)
    assert found.has_confidence
    error = angle_between_deg(found.estimate(observations, LIGHTS), normals).mean()
    assert angle_between_deg(teacher.normals, normals).mean() == approx(4, abs=0.1)
    assert angle_between_deg(LeastSquares().estimate(observations, LIGHTS), normals).mean() > 4
    assert error < 4 / 2
    told = found.distillation
    assert told.mean_deg == approx(4, abs=0.8)  # 200 pixels are held out
    assert told.expected_deg == approx(4, abs=0.2)
    assert told.held_out == approx(told.sample / 8, abs=1)
    assert teacher.asked == told.sample + found.n_unlike < 1800
    assert_allclose(np.linalg.norm(found.estimate(observations, LIGHTS), axis=1), 1, atol=1e-5)


@parametrize("followed", [True, False])
def test_it_learns_a_capture_anew_whose_observations_changed(followed):
    """The teacher says something else of the new observations. If that is noise,
    the teacher stays.
    """
    normals, observations = glossy()
    changed = observations**2
    said = normals[:, [1, 0, 2]] if followed else noisy(normals, 40)
    teacher = sure(np.concatenate((observations, changed)), np.concatenate((normals, said)), 4)
    found = distil(teacher, distant(observations), 8000, SIZE)
    anew = found.rebind(distant(changed), np.ones((80, 100), np.bool_))
    assert angle_between_deg(anew.estimate_with_error(changed, LIGHTS)[0], said).mean() < 3
    if followed:
        assert isinstance(anew, DistilledEstimator) and anew.n_unlike < 1000
    else:
        assert anew is teacher


def test_lamps_near_a_plane_of_bumps():
    """Lamps at two widths: their light turns by 25 degrees over the plane, which no single set of
    lights explains.
    """
    rng = default_rng(8)
    points = np.concatenate((rng.uniform(-1, 1, (8000, 2)), np.zeros((8000, 1))), axis=1)
    normals = cap_directions(8000, 40)[rng.permutation(8000)]
    towards = 4 * LIGHTS - points[:, None]
    directions = unit(towards)
    shading = np.einsum("pfc,pc->pf", directions, normals).clip(0)
    observations = (shading + 0.3 * shading**8).astype(np.float32)
    teacher = sure(observations, noisy(normals, 4), 4)
    found = distil(
        teacher, lambda rows: PixelLighting(observations[rows], directions[rows]), 8000, SIZE
    )
    error_deg = angle_between_deg(found.estimate(observations, directions), normals).mean()
    assert error_deg < 4 / 2
    assert angle_between_deg(LeastSquares().estimate(observations, directions), normals).mean() > 4
    far = angle_between_deg(learn(teacher).estimate(observations, LIGHTS), normals).mean()
    assert far > 1.5 * error_deg


def test_it_learns_where_its_teacher_is_unsure():
    normals = cap_directions(6000, 50)
    dull = np.arange(6000) % 2 == 0
    observations = np.float32(shade(normals, LIGHTS) ** np.where(dull, 1, 2)[:, None])
    errors = np.where(dull[:, None], log_median(1), log_median(12))
    found = learn(Remembering(observations, normals, errors))
    learned = confident_share(found.estimate_with_error(observations, LIGHTS)[1])
    truth = confident_share(np.float32(errors))
    assert np.abs(learned[dull].mean() - truth[dull].mean()) < 0.1
    assert np.abs(learned[~dull].mean() - truth[~dull].mean()) < 0.1


def test_a_rare_kind_of_pixel_is_left_to_the_teacher():
    """Fails if the sample is even, and if the perceptron estimates all other pixels."""
    normals, observations = glossy(20_000)
    rare = np.arange(20_000) % 1000 == 3
    observations[rare] = observations[rare][:, ::-1] ** 4
    taught = np.where(rare[:, None], np.array((0.6, 0.0, 0.8)), normals)
    found = learn(sure(observations, taught))
    angles = angle_between_deg(found.estimate(observations, LIGHTS), taught)
    assert (angles[rare] < 1e-3).mean() > 0.9
    assert found.n_unlike <= 0.01 * 20_000
    assert found.report()["unlike_pixels"] == found.n_unlike


def test_dark_pixels_have_no_normal():
    normals, observations = glossy(3000)
    observations[::100] = 0
    teacher = sure(observations, normals)
    estimate, errors = learn(teacher).estimate_with_error(observations, LIGHTS)
    assert_array_equal(estimate[::100], np.tile((0, 0, 1), (30, 1)))
    assert_allclose(errors[::100], np.tile(UNKNOWN_ERROR, (30, 1)), rtol=1e-6)


def test_the_same_seed_gives_the_same_and_no_other_draws_change():
    normals, observations = glossy(3000)
    teacher = sure(observations, normals)
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    first, again, other = (
        learn(teacher, SMALL, seed=seed).estimate(observations, LIGHTS) for seed in (1, 1, 2)
    )
    assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-4
    assert torch.equal(torch.rand(3), expected)


def test_too_few_pixels():
    """The sample is half of the lit pixels at most: of 127, 63."""
    normals, observations = glossy(127)
    teacher = sure(observations, normals)
    with refuses("only 127 pixels are lit, which is too few to distil the network", UsageError):
        learn(teacher)


def test_sizes_grow_with_the_capture():
    for n_pixels in (1000, 100_000, 24_000_000):
        usual, larger = student_sizes(n_pixels)
        assert usual.sample < larger.sample < n_pixels
        assert usual.width < larger.width


def clusters():
    """Return 5,000 features near the origin, 20 far away near (9, 0, 0), and one at (0, 30, 0)."""
    points = torch.randn(5021, 3, generator=seeded(1)) * 0.3
    points[5000:, 0] += 9
    points[5020] = torch.tensor((0.0, 30.0, 0.0))
    return points


def test_the_first_rows_are_an_even_sample():
    """The far cluster has its share of them, 0.4 %, and not more."""
    counts = [
        int((draw_sample(clusters(), 1200, seeded(seed)).rows[:600] >= 5000).sum())
        for seed in range(8)
    ]
    # Poisson of mean 20.1 in all: three standard deviations either way.
    assert 7 < sum(counts) < 34


def test_equal_pixels_are_one_group():
    sample = draw_sample(torch.ones(500, 4), 100, seeded(0))
    assert len(sample.rows) == 100
    assert sample.reach == 0
    assert not sample.unlike(torch.ones(3, 4)).any()
