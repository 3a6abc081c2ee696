"""All commands prepare a capture alike: the same warnings and the same normals, whatever it is."""

import warnings

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import splinecli
from scenes import (
    BUMP_LAMPS,
    codes,
    evaluate,
    parametrize,
    put,
    read_image,
    shade,
    sphere,
    spiral_lights,
    to_uint16,
    write_bump,
    write_capture,
    write_image,
)
from splinecli.estimate.methods.estimator import LeastSquares
from splinecli.evaluation.protocol import Protocol
from splinecli.maths.normals import angle_between_deg
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions, InfoOptions, ReadingOptions
from splinecli.pipeline.info import describe_capture

LIGHTS = spiral_lights(12, 50, 15)
NORMALS, MASK = sphere(64, 0.9)
WHITE, TUNGSTEN = (1.0, 1.0, 1.0), (1.0, 0.75, 0.5)
LAMPS = np.tile([WHITE, TUNGSTEN], (6, 1))


def paint(*colours):
    """Stripes (H, W, 3) of these colours, with some texture."""
    stripes = np.array(colours)[np.arange(64) // 8 % len(colours)]
    grain = np.random.default_rng(1).uniform(0.8, 1, (64, 64, 1))
    return np.asarray(stripes * cv2.GaussianBlur(grain, (0, 0), 1.0)[..., None])


SOFT = paint((0.8, 0.5, 0.4), (0.5, 0.6, 0.8))
STRONG = paint((0.9, 0.2, 0.1), (0.1, 0.3, 0.9))
GRAY = paint(WHITE)


def photograph(albedo, lamps=None, gloss=0.0):
    """Return 16-bit images (F, H, W, 3) of the ball, of which the brightest value is at 60,000."""
    lamps = np.ones((12, 3)) if lamps is None else lamps
    shading = np.where(MASK[..., None], shade(NORMALS, LIGHTS, gloss=gloss), 0)
    images = np.einsum("hwf,hwc,fc->fhwc", shading, albedo, lamps)
    return to_uint16(images / images.max() * 60_000)


def write(folder, images, **more):
    given = {"mask": MASK, "normals": np.float32(NORMALS), **more}
    return write_capture(folder, images, LIGHTS, **given)


def moved(images):
    """Return the images, of which three are shifted by some pixels."""
    found = images.copy()
    for place, shift in ((2, (3, -2)), (5, (-2, 4)), (9, (4, 3))):
        found[place] = np.roll(images[place], shift, axis=(0, 1))
    return found


def clipped(images):
    return np.uint16(np.where(images > 30_000, 65_535, images * 2))


def eight_bits(images):
    return np.uint8(np.rint(images / 257))


def blurred(images):
    return np.stack([cv2.GaussianBlur(image, (0, 0), 0.9) for image in images])


def near_lamps(folder):
    write_bump(folder)
    rows = "\n".join(" ".join(map(str, lamp)) for lamp in BUMP_LAMPS)
    put(folder / "light_positions.txt", f"{rows}\n")
    return folder


STILL = {
    "plain": lambda folder: write(folder, photograph(GRAY)),
    "glossy": lambda folder: write(folder, photograph(GRAY, gloss=0.4)),
    "coloured lamps": lambda folder: write(folder, photograph(SOFT, LAMPS)),
    "strongly coloured object": lambda folder: write(folder, photograph(STRONG, LAMPS)),
    "unequal lamps": lambda folder: write(
        folder, photograph(GRAY, np.linspace(0.6, 1, 12)[:, None].repeat(3, axis=1))
    ),
    "RGB intensities": lambda folder: write(folder, photograph(SOFT, LAMPS), intensities=LAMPS),
    "saturated": lambda folder: write(folder, clipped(photograph(GRAY))),
    "dark": lambda folder: write(folder, np.uint16(photograph(GRAY) // 40)),
    "8 bits": lambda folder: write(folder, eight_bits(photograph(GRAY))),
    "blurred": lambda folder: write(folder, blurred(photograph(GRAY))),
    "gray images": lambda folder: write(folder, photograph(GRAY)[..., 0]),
    "without mask": lambda folder: write(folder, photograph(GRAY), mask=None),
    "small under coloured lamps": lambda folder: write(
        folder,
        np.pad(photograph(STRONG, LAMPS), ((0, 0), (90, 90), (90, 90), (0, 0))),
        mask=None,
        normals=None,
    ),
    "near lamps": near_lamps,
}
OTHERS = {
    "moved": lambda folder: write(folder, moved(photograph(GRAY))),
    "moved under coloured lamps": lambda folder: write(folder, moved(photograph(SOFT, LAMPS))),
    "black image": lambda folder: write(
        folder, photograph(GRAY, np.repeat(np.arange(12)[:, None] != 3, 3, axis=1) * 1.0)
    ),
}


@parametrize("name", [*STILL, *OTHERS])
def test_all_commands_agree(tmp_path, name):
    """The warnings of info, the error of evaluate and the normals of Python are those of infer."""
    folder = (STILL | OTHERS)[name](tmp_path / "capture")
    reading = {"pixel_size": 2.0} if name == "near lamps" else {}
    for auto_mask in (False,) if (folder / "mask.png").exists() else (True, False):
        out = tmp_path / str(auto_mask)
        options = InferOptions(method="ls", output=str(out), auto_mask=auto_mask, **reading)
        report = infer_capture(folder, options)
        info = describe_capture(
            InfoOptions(capture=folder, auto_mask=auto_mask), ReadingOptions(**reading)
        )
        assert info["warnings"] == [warning["text"] for warning in report["warnings"]]
        assert info["warning_codes"] == codes(report)
        assert info["n_pixels"] == report["n_pixels"]
    if report["angular_error_deg"] and not reading:  # evaluate has no options of reading
        (result,) = evaluate([folder], [LeastSquares()], Protocol(None)).results
        mean_deg = report["angular_error_deg"]["mean"]
        if name.startswith("moved"):  # evaluate takes the input as it is
            assert report["mended"] == ["images_shifted"] and mean_deg < result.mae_deg / 2
        else:
            assert report["mended"] == []
            assert result.mae_deg == pytest.approx(mean_deg, abs=1e-3)  # as rounded in the report
    if name in OTHERS or name in ("8 bits", "near lamps", "small under coloured lamps"):
        return
    images = [read_image(path) for path in sorted(folder.glob("[0-9]*.png"))]
    stack = np.stack([image if image.ndim == 2 else image[..., ::-1] for image in images])
    known = LAMPS if name == "RGB intensities" else None
    mask = None if name == "without mask" else MASK
    lights = np.loadtxt(folder / "light_directions.txt")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that infer prints
        estimate = splinecli.estimate_normals(
            stack, lights, mask, light_intensities=known, method="ls"
        )
    assert_array_equal(estimate.normal_map, np.load(out / "capture/normals.npy"))


def with_and_without_align(tmp_path, name, **options):
    """Return the warnings and the normals of infer, first without --align."""
    folder = STILL[name](tmp_path / "capture")
    for align in (False, True):
        made = InferOptions(method="ls", output=str(tmp_path), align=align, **options)
        yield infer_capture(folder, made)["warnings"], np.load(tmp_path / "capture/normals.npy")


@parametrize("name", ["plain", "coloured lamps", "strongly coloured object", "blurred"])
def test_aligning_a_still_capture_changes_nothing(tmp_path, name):
    (told, normals), (again, aligned) = with_and_without_align(tmp_path, name)
    assert told == again
    assert_array_equal(normals, aligned)


@parametrize(
    "name, options",
    [
        ("strongly coloured object", {"strict": True}),
        ("small under coloured lamps", {"auto_mask": True}),
    ],
)
def test_coloured_lamps_leave_nothing_but_their_warning(tmp_path, name, options):
    """The pixels near the middle have no attached shadows, so least squares is exact there."""
    inside = cv2.circle(np.zeros((64, 64), np.uint8), (32, 32), 17, 1, cv2.FILLED) > 0
    for told, normals in with_and_without_align(tmp_path, name, **options):
        assert set(codes(told)) == {"estimated_colours", "estimated_intensities"}
        if "strict" in options:
            assert angle_between_deg(normals[inside], NORMALS[inside]).mean() < 0.1


@parametrize("given", [{"as_stored": True}, {"intensities": "equal"}], ids=str)
def test_colours_that_stay_are_no_motion(tmp_path, given):
    (_, normals), (_, aligned) = with_and_without_align(
        tmp_path, "strongly coloured object", **given
    )
    assert_array_equal(normals, aligned)


def test_images_that_are_not_used_may_have_another_size(tmp_path):
    folder = STILL["plain"](tmp_path / "capture")
    last = folder / "011.png"
    write_image(last, read_image(last)[:-4])
    options = {"method": "ls", "output": str(tmp_path), "light_indices": tuple(range(11))}
    assert infer_capture(folder, InferOptions(align=True, **options))["n_lights"] == 11
