"""Images that moved between exposures: the scenes are functions of the place, so a moved image is
exact.
"""

import json
import tracemalloc

import numpy as np
import pytest
from numpy.random import default_rng

from scenes import parametrize, refuses, ring_lights, shade, tilted, vectors, write_capture
from splinecli.errors import UsageError
from splinecli.images.alignment import (
    align_images,
    common_pixels,
    place_in_whole,
    reduced,
    resample,
)
from splinecli.images.registration import are_still
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions

SIDE = 120
LIGHTS = np.concatenate((ring_lights(5, 40), ring_lights(3, 20, 0.4)))


def scene(x, y, textured):
    """Return normals (..., 3) and albedo at places in pixels: a relief of bumps, on a dome that
    ends in the dark.
    """
    waves = default_rng(3)
    right, up = np.zeros_like(x), np.zeros_like(x)
    for _ in range(12):
        angle, length, phase = (
            waves.uniform(0, 2 * np.pi),
            waves.uniform(16, 40),
            waves.uniform(0, 2 * np.pi),
        )
        fx, fy = 2 * np.pi / length * np.array((np.cos(angle), np.sin(angle)))
        slope = 0.2 * np.cos(fx * x + fy * y + phase)
        right, up = right + slope * np.cos(angle), up - slope * np.sin(angle)
    middle = (SIDE - 1) / 2
    right, up = right + (x - middle) / SIDE, up - (y - middle) / SIDE
    albedo = np.ones_like(x)
    for _ in range(30 if textured else 0):
        angle, length, phase = (
            waves.uniform(0, 2 * np.pi),
            waves.uniform(5, 14),
            waves.uniform(0, 2 * np.pi),
        )
        albedo += 0.08 * np.cos(
            2 * np.pi / length * (np.cos(angle) * x + np.sin(angle) * y) + phase
        )
    rim = 1 / (1 + np.exp((np.hypot(x - middle, y - middle) - 0.42 * SIDE) / 0.7))
    return tilted(right, up), albedo * rim


def photographs(transforms, *, textured, gloss=0.0):
    """Return the images (F, SIDE, SIDE) of a camera that moved: the reference's pixel p is at
    transform @ p.
    """
    columns, rows = np.meshgrid(np.arange(SIDE, dtype=float), np.arange(SIDE, dtype=float))
    places = np.stack((columns, rows, np.ones_like(rows))).reshape(3, -1)
    images = []
    for light, transform in zip(LIGHTS, transforms, strict=True):
        x, y, w = (np.linalg.inv(transform) @ places).reshape(3, SIDE, SIDE)
        normals, albedo = scene(x / w, y / w, textured)
        images.append(albedo * shade(normals, light[None], gloss=gloss)[..., 0])
    return np.array(images, np.float32)


def motions(pixels, kind):
    """Return transforms of which the first is none, and the others move points by about so many
    pixels.
    """
    rng, middle = (
        default_rng(int(10 * pixels)),
        np.array([[1, 0, SIDE / 2], [0, 1, SIDE / 2], [0, 0, 1]]),
    )
    found = [np.eye(3)]
    for _ in LIGHTS[1:]:
        angle = rng.uniform(0, 2 * np.pi)
        turn, zoom = rng.uniform(-0.5, 0.5, 2) * 2 * pixels / SIDE
        move = np.eye(3)
        move[:2, 2] = pixels * np.array((np.cos(angle), np.sin(angle)))
        if kind != "translation":
            move[:2, :2] = (1 + zoom) * np.array(
                [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
            )
        if kind == "homography":
            move[2, :2] = rng.uniform(-1, 1, 2) * pixels / SIDE**2
        found.append(middle @ move @ np.linalg.inv(middle))
    return np.array(found)


MASK = np.hypot(*(np.indices((SIDE, SIDE)) - (SIDE - 1) / 2)) < 0.42 * SIDE
PLACES = np.stack((*np.nonzero(MASK)[::-1], np.ones(MASK.sum())))


def residuals(found, true):
    """Return the root mean square distances (F - 1,) in pixels over the object."""
    points = [each @ PLACES for each in (found[1:], true[1:])]
    one, other = (each[:, :2] / each[:, 2:] for each in points)
    return np.asarray(np.sqrt(((one - other) ** 2).sum(axis=1).mean(axis=1)))


@parametrize("lights", [LIGHTS, None], ids=["lights", "unknown-lights"])
@parametrize("pixels", [0.3, 2.0, 20.0])
def test_the_motion_of_a_textured_object_is_found_to_a_tenth_of_a_pixel(pixels, lights):
    true = motions(pixels, "translation")
    found = align_images(photographs(true, textured=True), MASK, lights)
    assert residuals(found.transforms, true).max() < 0.1
    assert found.unexplained is None


@parametrize("pixels", [1.0, 10.0])
def test_the_motion_of_a_plain_object_is_found_to_a_third_of_a_pixel(pixels):
    true = motions(pixels, "translation")
    found = align_images(photographs(true, textured=False, gloss=0.3), MASK, LIGHTS)
    assert residuals(found.transforms, true).max() < 0.3


@parametrize("kind", "similarity homography")
def test_rotation_zoom_and_perspective_are_found(kind):
    true = motions(4.0, kind)
    found = align_images(photographs(true, textured=True), MASK, LIGHTS)
    assert found.model == kind
    assert residuals(found.transforms, true).max() < 0.15


@parametrize("gloss", [0.0, 0.3, 2.0])
@parametrize("textured", [True, False])
def test_images_that_did_not_move_are_left_as_they_are(textured, gloss):
    still = photographs(motions(0, "translation"), textured=textured, gloss=gloss)
    found = align_images(still, MASK, LIGHTS)
    assert (found.transforms == np.eye(3)).all()
    assert found.unexplained is None
    assert not are_still(still[:, :12], MASK[60:72], LIGHTS)  # too thin to be judged


@parametrize("textured", [True, False])
def test_one_image_that_moved_by_a_pixel_is_found(textured):
    true = motions(0, "translation")
    true[4, 0, 2] = 1.0
    found = align_images(photographs(true, textured=textured), MASK, LIGHTS)
    assert residuals(found.transforms, true).max() < 0.1


@parametrize(
    "spoil",
    [
        lambda image: image[::-1, ::-1],
        lambda image: default_rng(0).uniform(0, 1, image.shape),
        lambda image: default_rng(0).uniform(0, 1, image.shape) * MASK,
    ],
    ids=["upside-down", "another-object", "another-object-of-its-shape"],
)
@parametrize("textured", [True, False])
def test_an_image_that_fits_nowhere_is_named(spoil, textured):
    images = photographs(motions(2.0, "translation"), textured=textured, gloss=0.3)
    images[3] = spoil(images[3])
    assert align_images(images, MASK, LIGHTS).unexplained == 3


def test_transforms_of_reduced_windows_hold_in_whole_images():
    shift = np.eye(3)[None].repeat(2, 0)
    shift[1, :2, 2] = 1.5, -0.5
    whole = place_in_whole(shift, left=10, top=20, stride=3)
    assert whole[1] == pytest.approx(vectors("1 0 4.5; 0 1 -1.5; 0 0 1"))
    assert reduced(np.arange(35, dtype=np.float32).reshape(5, 7), 3).tolist() == [[8.0, 11.0]]


def test_pixels_that_an_image_lacks_are_not_common():
    transforms = np.eye(3)[None].repeat(2, 0)
    transforms[1, :2, 2] = 2.0, -1.0
    common = common_pixels(transforms, (4, 6))
    assert common.tolist() == [[False] * 6, *[[True] * 4 + [False] * 2] * 3]


@parametrize(
    ("work", "most"),
    [
        # the nearest pixels in two bytes, and the interpolated ones in four
        (lambda image, motion: resample(image, np.float32(image), motion), 6 + 4),
        (lambda image, motion: common_pixels(motion[None], image.shape[:2]), 1),
    ],
)
def test_whole_images_take_no_memory_but_for_their_values(work, most):
    """The memory of a capture is checked before it is read, without the places of its pixels."""
    image, motion = np.ones((1000, 1000, 1), np.uint16), np.eye(3)
    motion[:2, 2] = 1.5, -0.5
    tracemalloc.start()
    work(image, motion)
    taken = tracemalloc.get_traced_memory()[1] / image.size
    tracemalloc.stop()
    assert taken < most + 5


@pytest.fixture
def write_moved(tmp_path):
    def write(spoilt=False, pixels=3.0):
        images = photographs(motions(pixels, "translation"), textured=True)
        if spoilt:
            images[2] = default_rng(0).uniform(0, 1, (SIDE, SIDE))
        stored = np.uint16(np.rint(images / images.max() * 60_000))
        return write_capture(tmp_path / "moved", stored, LIGHTS, mask=MASK)

    yield write


def infer(folder, tmp_path, **options):
    return infer_capture(
        folder, InferOptions(align=True, method="ls", output=str(tmp_path / "out"), **options)
    )


def test_infer_aligns_and_reports(write_moved, tmp_path):
    report = infer(write_moved(), tmp_path)
    written = json.loads((tmp_path / "out/moved/report.json").read_text())
    assert written["alignment"]["reference"] == "000.png"
    assert (
        residuals(np.array(written["alignment"]["transforms"]), motions(3.0, "translation")).max()
        < 0.1
    )
    codes = [warning["code"] for warning in report["warnings"]]
    assert "images_aligned" in codes and "images_shifted" not in codes
    part = infer(
        write_moved(), tmp_path / "part", crop="10,10,100,100", light_indices=(1, 2, 3, 4, 5)
    )
    assert part["alignment"]["reference"] == "001.png" and len(part["alignment"]["transforms"]) == 5


def test_unmoved_images_are_no_reason_to_warn(write_moved, tmp_path):
    report = infer(write_moved(pixels=0.0), tmp_path)
    assert "images_aligned" not in [warning["code"] for warning in report["warnings"]]
    assert max(report["alignment"]["moved_pixels"]) < 0.1


def test_captures_that_cannot_be_aligned_are_refused(write_moved, tmp_path):
    with refuses(r"cannot match 002\.png"):
        infer(write_moved(spoilt=True), tmp_path)
    for options in ({"light_indices": (0, 1, 2, 3)}, {"n_lights": 4}):
        with refuses("leaves 4 images, but --align needs at least 5", UsageError):
            infer(write_moved(), tmp_path, **options)
    for crop, size in (("60,60,30,1", "30 x 1"), ("60,60,1,30", "1 x 30"), ("60,60,1,1", "1 x 1")):
        with refuses(f"found an object of {size} pixels, expected .* 8 x 8"):
            infer(write_moved(), tmp_path, crop=crop)
