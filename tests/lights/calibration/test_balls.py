"""From folders of photographs to the lights."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenes import decode_rgb, parametrize, refuses, to_uint16, write_image
from splinecli.capture import read_light_directions
from splinecli.lights.calibration.balls import calibrate_ball, combine_balls, find_ball_files
from splinecli.lights.calibration.circle import Circle
from splinecli.maths.normals import angle_between_deg
from splinecli.pictures.plots import calibration_picture

BALL = Circle(103.3, 88.7, 61.4)


def write(folder, name, picture):
    folder.mkdir(exist_ok=True)
    write_image(folder / name, to_uint16(picture.clip(0, 1) * 65535))
    return folder


@pytest.fixture
def ball(tmp_path, render_ball, lights):
    """A folder with the ball under each light."""
    for number, light in enumerate(lights, start=1):
        write(tmp_path / "ball", f"{number}.png", render_ball(light, lamp=0.9))
    return tmp_path / "ball"


@parametrize("outline", "--circle mask picture reference")
def test_lights_of_a_ball(ball, render_ball, lights, outline):
    if outline == "mask":
        write(ball, "mask.png", np.float64(BALL.inside((180, 210))))
    if outline == "reference":
        write(ball, "Ref.png", np.where(BALL.inside((180, 210)), 0.1, 0.9))
    files = find_ball_files(ball)
    assert [path.name for path in files.images] == [f"{number}.png" for number in range(1, 8)]
    found = calibrate_ball(files, circle=BALL if outline == "--circle" else None)
    assert found.circle_from == outline.replace("reference", "picture")
    off = angle_between_deg(found.directions, lights)
    # A pixel of the ball is 1.9 degrees of light; the outline is found to a fraction of one.
    assert off.max() < (0.8 if outline == "--circle" else 1.8)
    half_way = angle_between_deg(found.normals, np.array((0.0, 0.0, 1.0)))
    assert_allclose(half_way, np.linspace(0, 60, 7) / 2, atol=0.9)
    picture = decode_rgb(calibration_picture((found,)))
    assert picture.shape == (2 * 225, 6 * 200, 3)
    red, green, _ = picture[:225, 200:400].astype(int).transpose(2, 0, 1)
    assert (red > green + 100).sum() > 20
    assert (green > red + 50).sum() > 200


def test_several_balls_are_averaged(ball, tmp_path, render_ball, lights):
    second = Circle(80.2, 70.9, 50.0)
    for number, light in enumerate(lights, start=1):
        picture = render_ball(light, second.x, second.y, second.radius, lamp=0.9)
        write(tmp_path / "second", f"{number}.png", picture)
    one = calibrate_ball(find_ball_files(ball), circle=BALL)
    moved = Circle(second.x + 1, second.y, second.radius)
    other = calibrate_ball(find_ball_files(tmp_path / "second"), circle=moved)
    both = combine_balls([one, other])
    between = angle_between_deg(one.directions, other.directions)
    # Of two directions the mean lies in the middle.
    assert_allclose(both.disagreement_deg, between / 2, atol=1e-6)
    assert between.mean() > 1
    assert combine_balls([one]).disagreement_deg.tolist() == [0] * 7


def test_pictures_of_another_size(ball):
    write(ball, "3.png", np.zeros((50, 60)))
    for circle in (BALL, None):
        with refuses(r"3\.png: found an image of 60 x 50 pixels, expected 210 x 180"):
            calibrate_ball(find_ball_files(ball), circle=circle)


def test_real_balls(shared_data):
    chrome = calibrate_ball(find_ball_files(shared_data / "uw/chrome"))
    off = angle_between_deg(
        chrome.directions, read_light_directions(shared_data / "uw/gray/light_directions.txt")
    )
    assert off.mean() < 0.6
    assert off.max() < 1
    probes = [
        calibrate_ball(find_ball_files(shared_data / f"psbox/LightProbe-{number}"))
        for number in (1, 2)
    ]
    expected = read_light_directions(shared_data / "psbox/light_directions.txt")
    for probe in probes:
        assert angle_between_deg(probe.directions, expected).mean() < 2
    assert angle_between_deg(combine_balls(probes).directions, expected).mean() < 1
