"""Three coloured lamps at once: gray spheres whose crosstalk and normals are known."""

import cv2
import numpy as np
import pytest

from scenes import (
    codes,
    parametrize,
    put,
    read_json,
    refuses,
    ring_lights,
    shade,
    sphere,
    to_uint16,
    vectors,
    write_capture,
    write_image,
)
from splinecli.capture.channel_lights import channel_lights
from splinecli.errors import UsageError
from splinecli.lights.calibration.balls import find_ball_files
from splinecli.lights.calibration.crosstalk import measure_crosstalk
from splinecli.maths.normals import angle_between_deg
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions, InfoOptions, ReadingOptions
from splinecli.pipeline.info import describe_capture, summary_lines

NORMALS, MASK = sphere(90)
LIGHTS = np.concatenate((ring_lights(3, 35), ring_lights(3, 50, 0.8)))
CROSSTALK = vectors("1 0.2 0.05; 0.15 1.3 0.2; 0.02 0.25 0.7")


def photograph(lights, crosstalk=CROSSTALK, paint=1.0):
    """Return colour images (N, H, W, 3) of a sphere under three lights (3 N, 3) each; `paint` has
    its colours.
    """
    shading = shade(NORMALS, lights).reshape(*MASK.shape, -1, 3) * MASK[..., None, None]
    images = np.moveaxis(shading, 2, 0) @ crosstalk.T * paint
    return to_uint16(images * 30_000)


def write(folder, count, paint=1.0):
    lights = LIGHTS[: 3 * count]
    write_capture(
        folder,
        photograph(lights, paint=paint),
        lights,
        mask=MASK,
        normals=np.float32(NORMALS),
    )
    np.savetxt(folder / "crosstalk.txt", CROSSTALK)
    return folder


def normals_of(folder, out, **options):
    options = {"method": "ls"} | options
    infer_capture(folder, InferOptions(lights_in_channels=True, output=str(out), **options))
    return np.asarray(np.load(out / folder.name / "normals.npy"), np.float64)


def errors_deg(folder, out, lights, **options):
    """Return the errors where all lights reach."""
    lit = MASK & (NORMALS @ lights.T > 0.05).all(axis=2)
    return angle_between_deg(normals_of(folder, out, **options)[lit], NORMALS[lit])


@parametrize("count", [1, 2])
def test_a_colour_image_gives_the_normals_of_a_gray_sphere(count, tmp_path):
    folder = write(tmp_path / "gray", count)
    assert errors_deg(folder, tmp_path / "out", LIGHTS[: 3 * count]).max() < 0.2
    report = read_json(tmp_path / "out/gray/report.json")
    assert report["n_lights"] == 3 * count and "lights_in_channels" in codes(report)


def test_messages_count_the_lights_of_channels(tmp_path):
    folder = write(tmp_path / "gray", 1)
    reading = ReadingOptions(lights_in_channels=True)
    report = describe_capture(InfoOptions(capture=folder), reading)
    assert report["images"] == 1 and "few_lights" not in report["warning_codes"]
    assert "images       1 (000.png): 90 x 90, RGB" in summary_lines(report)[1]
    assert reading.open(folder).image_names((0, 2)) == ["000.png (R)", "000.png (B)"]
    np.savetxt(folder / "light_directions.txt", LIGHTS[:1])
    with refuses(r"found 1 light direction, expected 3, three for each image.* R, G, B"):
        reading.open(folder)


def test_the_networks_take_two_images(tmp_path):
    folder = write(tmp_path / "gray", 2)
    assert errors_deg(folder, tmp_path / "out", LIGHTS, method="spline-net").mean() < 4


def test_paint_is_taken_for_shading(tmp_path):
    folder = write(tmp_path / "red", 1, paint=np.array((1.0, 0.4, 0.4)))
    assert errors_deg(folder, tmp_path / "out", LIGHTS[:3]).mean() > 5


def test_the_intensities_of_the_lamps_are_divided_out(tmp_path):
    folder, uneven = tmp_path / "gray", np.diag((1.0, 1.5, 0.6))
    write_capture(folder, photograph(LIGHTS, uneven), LIGHTS, mask=MASK)
    np.savetxt(folder / "light_intensities.txt", np.tile(np.diag(uneven), (2, 1)))
    assert errors_deg(folder, tmp_path / "out", LIGHTS).max() < 0.2


def test_each_image_has_its_flat_field(tmp_path):
    """The lamps of the two images fall off towards opposite sides."""
    falloff = np.linspace(0.4, 1, 90)[:, None, None] * np.ones((90, 90, 3))
    falloff = np.stack((falloff, falloff[::-1]))
    folder, flats = tmp_path / "gray", tmp_path / "flats"
    write_capture(folder, to_uint16(photograph(LIGHTS, np.eye(3)) * falloff), LIGHTS, mask=MASK)
    write_capture(flats, to_uint16(falloff * 50_000), None)
    assert errors_deg(folder, tmp_path / "out", LIGHTS, flat_field=str(flats)).max() < 0.2
    write_capture(flats, to_uint16(falloff[:1] * 50_000), None, first=2)
    with refuses("found 3 flat-field images, expected 1 or 2, one for"):
        normals_of(folder, tmp_path / "other", flat_field=str(flats))


def test_crosstalk_is_measured_on_a_gray_ball(tmp_path):
    write_capture(tmp_path / "ball", photograph(LIGHTS), None, mask=MASK)
    found = measure_crosstalk(find_ball_files(tmp_path / "ball"), LIGHTS)
    expected = CROSSTALK / np.trace(CROSSTALK) * 3
    assert found == pytest.approx(np.stack((expected, expected)), abs=0.02)
    with refuses("2 colour images of the gray ball and 3 lights"):
        measure_crosstalk(find_ball_files(tmp_path / "ball"), LIGHTS[:3])


def test_what_does_not_fit_is_refused(tmp_path):
    write(tmp_path / "gray", 1)
    put(tmp_path / "matrix.txt", "1 1 1\n1 1 1\n1 1 1.1\n")
    with refuses("the lamps cannot be separated"):
        channel_lights(tmp_path / "matrix.txt", 1)
    put(tmp_path / "matrix.txt", "1 0 0\n0 1 0\n0 -0.2 1\n")
    with refuses(r"found a negative response \(-0\.2\)"):
        channel_lights(tmp_path / "matrix.txt", 1)
    put(tmp_path / "matrix.txt", "1 0\n0 1\n")
    with refuses("found 2 x 2 numbers, expected 3 x 3"):
        normals_of(tmp_path / "gray", tmp_path / "out", crosstalk=str(tmp_path / "matrix.txt"))
    name = str(tmp_path / "gray/000.png")
    write_image(name, cv2.imread(name, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH))
    with refuses("the image is gray"):
        normals_of(tmp_path / "gray", tmp_path / "out")
    for options in ({"crosstalk": "matrix.txt"}, {"lights_in_channels": True, "align": True}):
        with pytest.raises(UsageError):
            InferOptions(**options)
