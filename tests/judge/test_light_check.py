"""Wrong light files are told from right ones, on surfaces whose normals are known."""

from functools import partial

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

import scenes
from scenes import parametrize, refuses, ring_lights, spiral_lights, tilted
from splinecli.capture.light_rows import PLANE_FRAMES, parse_light_frame
from splinecli.errors import UsageError
from splinecli.judge.light_check import check_lights
from splinecli.judge.light_order import UNKNOWN_ORDER
from splinecli.lights.light_fit import find_factors
from splinecli.maths.normals import unit
from splinecli.recipe import read_capture

SIZE = 64
SHIFTED = "if image 1 belongs to light 2, image 2 to the next, and so on"
ring = partial(ring_lights, zenith_deg=40, first_rad=0.3)
# Lambert's cosine with a Blinn-Phong highlight and attached shadows, and one part in a hundred of
# noise
shade = partial(scenes.shade, gloss=0.3, noise=0.01)


def scattered(count=14):
    """Lights on a spiral, so that no shift or exchange takes them to each other."""
    return spiral_lights(count, 55, 12)


def vase():
    """The normals (P, 3) of a tilted ellipsoid with a dent, and its mask: z = sqrt(1 - u^2 - 2 v^2)
    - bump.
    """
    y, x = -np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    x = -x
    u, v = 0.8 * x + 0.5 * y, 1.1 * y - 0.3 * x
    inside = u**2 + 1.6 * v**2 < 0.97
    z = np.sqrt(np.maximum(1 - u**2 - 1.6 * v**2, 0.03)) - 0.12 * np.exp(
        -((x - 0.2) ** 2 + (y - 0.1) ** 2) / 0.05
    )
    z_row, z_x = np.gradient(z, 2 / (SIZE - 1))
    return tilted(-z_x, z_row)[inside], inside


def check_vase(lights, read_as, gloss=0.3):
    normals, mask = vase()
    return check_lights(scenes.shade(normals, lights, gloss=gloss, noise=0.01), mask, read_as)


@parametrize("lights", [scattered(), scattered(6), ring(8), ring(12)], ids=len)
def test_right_lights_are_not_doubted(lights):
    check = check_vase(lights, lights)
    assert check.order is None
    assert check.best is None
    assert check.given.curl < 0.2
    assert check.given.rim > 0.9
    assert any("elevation" in each for each in check.unchecked) == (len(lights) in (8, 12))


@parametrize("frame", PLANE_FRAMES[1:], ids=str)
def test_each_wrong_frame_is_named_with_the_frame_that_mends_it(frame):
    lights = scattered()
    # The inverse of the frame writes the file, so that reading it in the frame gives the lights.
    check = check_vase(lights, lights @ np.linalg.inv(frame.matrix).T)
    assert check.order is None
    assert check.best.frame == frame


ORDERS = {
    "right": (np.arange(14), None),
    "swapped": (np.r_[0, 1, 9, 3:9, 2, 10:14], "with the lights of 3 and 10 exchanged"),
    "shuffled": (np.random.default_rng(1).permutation(14), UNKNOWN_ORDER),
    "shifted": (np.roll(np.arange(14), 1), SHIFTED),
    "reversed": (np.arange(14)[::-1], "in reversed order, beginning with light 14"),
}


@parametrize("name", list(ORDERS)[1:])
def test_each_wrong_order_is_named(name):
    order, words = ORDERS[name]
    check = check_vase(scattered(), scattered()[order])
    assert check.order == words
    assert check.best is None
    assert check.given_misfit > 0.3


@parametrize(
    ("order", "words"),
    [
        (np.roll(np.arange(12), 1), SHIFTED),
        (np.arange(12)[::-1], "in reversed order, beginning with light 12"),
    ],
)
def test_a_ring_that_fits_in_every_shift_is_told_by_its_normals(order, words):
    check = check_vase(ring(12), ring(12)[order])
    assert check.order is None, "a turned ring fits as well"
    assert check.best.name == words


def test_a_relief_that_fills_the_picture_has_no_outline():
    y, x = np.mgrid[0 : 3 : SIZE * 1j, 0 : 3 : SIZE * 1j]
    z_x, z_y = 0.4 * np.cos(2 * x) * np.sin(3 * y), 0.6 * np.sin(2 * x) * np.cos(3 * y)
    normals = tilted(-z_x, z_y).reshape(-1, 3)
    mask, lights = np.ones((SIZE, SIZE), np.bool_), scattered()
    observations = shade(normals, lights)
    right = check_lights(observations, mask, lights)
    assert right.best is None and np.isnan(right.given.rim)
    flipped = check_lights(observations, mask, lights * (1, -1, 1))
    # Which of both axes is wrong, the curl does not tell.
    assert flipped.best.frame.signs[0] != flipped.best.frame.signs[1]


def metal(normals, lights):
    """A highlight, whose brightness varies from image to image, and hardly any matte reflection."""
    lit = np.clip(normals @ lights.T, 0, None)
    return (
        0.02 * lit
        + np.clip(normals @ scenes.halfway(lights).T, 0, None) ** 40 * (lit > 0) / lights[:, 2]
    )


@parametrize("name", "right swapped shuffled")
def test_the_order_of_metal_is_judged(name):
    (normals, mask), (order, words) = vase(), ORDERS[name]
    assert check_lights(metal(normals, scattered()), mask, scattered()[order]).order == words


def test_on_a_flat_relief_only_known_intensities_tell_the_order():
    y, x = np.mgrid[0 : 3 : SIZE * 1j, 0 : 3 : SIZE * 1j]
    normals = tilted(-0.03 * np.cos(3 * x), 0.03 * np.sin(2 * y)).reshape(-1, 3)
    mask, lights = np.ones((SIZE, SIZE), np.bool_), scattered()
    observations = shade(normals, lights)
    for given, known, order in (
        (lights, True, None),
        (lights, False, None),
        (np.roll(lights, 1, 0), True, SHIFTED),
    ):
        factors = find_factors(observations, intensities_known=known)
        check = check_lights(observations, mask, given, factors=factors)
        assert check.order == order
        assert np.isnan(check.given_misfit) == (not known)


def test_the_columns_of_an_exchanged_file():
    # The file has y before x, and its y points down: (y, x, z) = (0.2, 0.5, 0.8) is x = 0.5, y =
    # -0.2.
    frame = parse_light_frame("swap-xy, y-down")
    assert_array_equal(np.array((0.2, 0.5, 0.8)) @ frame.matrix.T, (0.5, -0.2, 0.8))
    assert frame.describe() == "x and y exchanged, y negated"


@parametrize("text", ["down", "y-down,y-up", ""])
def test_refused_frames(text):
    with refuses("--light-frame is", UsageError):
        parse_light_frame(text)


@parametrize("name", "DiLiGenT/pmsData/ballPNG DiLiGenT/pmsData/catPNG uw/gray uw/horse")
def test_real_captures(shared_data, name):
    chosen = None if "uw" in name else list(range(3, 96, 7))
    capture = read_capture(shared_data / name, light_indices=chosen)
    lights = capture.light_directions
    right = check_lights(capture.observations, capture.mask, lights)
    assert right.order is None
    assert right.best is None
    assert right.odd_image is None
    flipped = check_lights(capture.observations, capture.mask, lights * (1, -1, 1))
    assert flipped.best is not None and str(flipped.best.frame) == "y-down"


def test_a_few_outshining_pixels_do_not_hide_the_object():
    normals, _ = vase()
    observations = shade(normals, scattered())
    observations[::100] *= 40  # mirror-like highlights
    assert find_factors(observations).misfits(scattered()[None])[0] < 0.05


@parametrize("shape", [(1, 60), (60, 1), (1, 1)])
def test_a_line_of_pixels_tells_no_frame(shape, rng):
    lights = unit(rng.normal((0, 0, 1), 0.3, (12, 3)))
    normals = unit(rng.normal((0, 0, 1), 0.2, (shape[0] * shape[1], 3)))
    assert check_lights((normals @ lights.T).clip(0), np.ones(shape, bool), lights).best is None


def dome(*counts):
    """Lights in rings of so many lamps, from low to high, each turned by ten degrees against the
    one below.
    """
    step = 50 / max(len(counts) - 1, 1)
    rings = (
        ring_lights(count, 70 - step * place, np.radians(10 * place))
        for place, count in enumerate(counts)
    )
    return np.concatenate(list(rings))


@parametrize("frame", [(1, 1, 1), (-1, 1, 1)], ids=["in its frame", "x negated"])
@parametrize("counts", [(12, 12, 12, 12), (16, 12, 8), (8, 6)], ids=str)
def test_rings_that_begin_at_another_lamp(counts, frame):
    lights = dome(*counts)
    read_as, ends = lights.copy(), np.cumsum(counts)
    for start, stop in list(zip(ends - counts, ends, strict=True))[1::2]:
        read_as[start:stop] = np.roll(lights[start:stop], 1, axis=0)
    check = check_vase(lights, read_as * frame)
    assert (
        check.order is not None
        and f"lights {counts[0] + 1} to {counts[0] + counts[1]}" in check.order
    )
    assert_allclose(check.mended, lights, atol=1e-6)


def test_a_ring_that_runs_the_other_way_round():
    lights = dome(12, 12, 12)
    check = check_vase(lights, np.concatenate((lights[:12], lights[12:24][::-1], lights[24:])))
    assert check.order == "with lights 13 to 24 reversed"
    assert_allclose(check.mended, lights, atol=1e-6)


@parametrize("counts", [(12, 12, 12, 12), (16, 12, 8), (8, 6)], ids=str)
@parametrize("gloss", [0.0, 0.3, 0.8])
def test_right_rings_are_not_doubted(counts, gloss):
    check = check_vase(dome(*counts), dome(*counts), gloss)
    assert check.order is None
    assert check.best is None
    assert check.mended is None
