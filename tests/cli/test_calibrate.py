"""`splinecli calibrate`: its files, messages and errors, on synthetic mirror balls."""

from pathlib import Path

import cv2
import numpy as np

from scenes import (
    ball,
    halfway,
    names_in,
    pinhole,
    put,
    read_image,
    read_json,
    to_uint16,
    vectors,
    write_capture,
    write_image,
    write_mirror_ball,
)
from splinecli.capture import read_light_directions
from splinecli.maths.normals import angle_between_deg

SIZE = (100, 120)
NORMALS, INSIDE = ball(SIZE, 60, 48, 40)
LIGHTS = vectors("0 0 1; 0.6 0 0.8; -0.48 0.36 0.8; 0 -0.6 0.8")


def write_balls(name, lights=LIGHTS, wall=0.2):
    return write_mirror_ball(Path(name), NORMALS, INSIDE, lights, wall=wall)


def write_gray(intensities):
    shading = (NORMALS @ LIGHTS.T).clip(0).transpose(2, 0, 1) * INSIDE
    images = 0.5 * np.array(intensities)[:, None, None] * shading
    write_capture(Path("gray"), to_uint16(images * 65535), None, mask=INSIDE, names="{}.png")


def angles_deg(found):
    return angle_between_deg(found, LIGHTS)


def test_one_ball(run):
    write_balls("ball")
    result = run(
        "calibrate ball",
        says="from picture, 100 % of the outline visible",
        out="calibration/light_directions.txt\n",
    )
    assert result.err.startswith("ball: circle 60.")
    assert angles_deg(read_light_directions("calibration/light_directions.txt", 4)).max() < 1.5
    height, width, _ = cv2.imread("calibration/calibration.png").shape
    assert 200 < height < 240 and width == 800, "four images of 200 pixels under their title"
    assert not Path("calibration/light_intensities.txt").exists()


def test_an_outline_given_by_the_user(document):
    write_balls("ball")
    report = document("calibrate ball --circle 60,48,40 -o out")
    assert report["balls"][0]["circle"] == {
        "x": 60.0,
        "y": 48.0,
        "radius": 40.0,
        "from": "--circle",
        "seen": 1.0,
        "spread": 0.0,
    }
    assert angles_deg(np.array(report["light_directions"])).max() < 0.6
    assert report["disagreement_deg"] is None
    assert read_json("out/calibration.json") == report


def test_positions_need_the_camera(run):
    """Two balls side by side show distant lamps alike."""
    for name, pads in (("one", (0, 180)), ("two", (180, 0))):
        for path in write_balls(name).iterdir():
            write_image(path, np.pad(read_image(path), ((0, 0), pads), constant_values=13107))
    circles = "--circle 60,48,40 --circle 240,48,40"
    result = run(
        f"calibrate one two {circles}",
        says=(
            "the distances of the lamps are unknown, so the lamps are treated as distant",
            "warning: The lamps' distances are unknown, because the camera is",
        ),
    )
    assert not Path("calibration/light_positions.txt").exists()
    matrix = pinhole(1000, 149.5, 49.5)
    np.savetxt("matrix.txt", matrix)
    arguments = f"calibrate one two {circles} --overwrite --json --camera-matrix matrix.txt"
    report = run(arguments).json
    assert report["camera"] == {"from": "--camera-matrix", "matrix": matrix.tolist()}
    known = report["lamp_positions"]["known"]
    for name in ("light_positions.txt", "pixel_size.txt", "camera_matrix.txt"):
        assert Path("calibration", name).exists() == known
    put("matrix.txt", "900 0\n0 900\n")
    result = run(arguments, code=3)
    assert "matrix.txt: found 2 x 2 numbers, expected 3 x 3" in result.out


def test_the_normals_are_not_the_lights(run):
    write_balls("ball")
    np.savetxt("mistake.txt", halfway(LIGHTS))
    run(
        "calibrate ball --circle 60,48,40 --compare mistake.txt",
        says=(
            "the compared file differs by 13.",
            "warning: The compared file contains the normals of the ball at the highlights",
        ),
    )


def test_an_uncertain_outline(run):
    write_balls("one")
    mask = INSIDE.astype(np.uint8) * 255
    mask[:48] = 0
    write_image("half.png", mask)
    run(
        "calibrate one --mask half.png -o half",
        says="warning: one: the outline of the ball is uncertain (",
    )


def test_an_outline_that_may_not_be_the_balls(run):
    """A brushed ball on a bright round table, whose edge is as clear as its own."""
    n, inside = ball((260, 280), 120, 140, 40)
    round_table = np.where(ball(inside.shape, 140, 130, 110)[1], 0.15, 0.03)
    for number, half in enumerate(halfway(LIGHTS)):
        picture = np.where(inside, 0.02 + 0.9 * (n @ half).clip(0) ** 80, round_table)
        write_image(f"disc/{number}.png", to_uint16(picture * 65535))
    run(
        "calibrate disc",
        input_error=(
            "disc: the circle in the images (centre 140, 130, radius 110 pixels) may not be the",
            "(centre 120, 140, radius 40 pixels) is also clear and contains all highlights.",
            "calibration/calibration.png shows it. Give the ball's circle with --circle X,Y,R,",
        ),
    )
    assert names_in("calibration") == {"calibration.png"}
    run("calibrate disc --circle 120,140,40 --overwrite", says="from --circle")
    assert angles_deg(read_light_directions("calibration/light_directions.txt", 4)).max() < 1.5
    write_balls("still", LIGHTS[[1, 1, 1, 2]])
    run("calibrate still -o still", input_error="the highlight does not move in most images")


def test_two_masks_of_a_ball_are_named(run):
    write_balls("ball")
    for name in ("ball.mask.pgm", "old_mask.png"):
        write_image(f"ball/{name}", INSIDE.astype(np.uint8) * 255)
    says = "several files could be the mask: ball.mask.pgm, old_mask.png. Choose one with"
    run("calibrate ball", says=(says, "from picture"))


def test_a_ball_in_jpeg_images(run):
    """Decoded, the lamp is 20 times as bright as the ball; stored values are only 4 times as
    high.
    """
    Path("jpeg").mkdir()
    for number, half in enumerate(halfway(LIGHTS)):
        spot = (NORMALS @ half).clip(0) ** 200
        cv2.imwrite(f"jpeg/{number}.jpg", np.where(INSIDE, 64 + 191 * spot, 0).round())
    cv2.imwrite("mask.png", INSIDE.astype(np.uint8) * 255)
    run("calibrate jpeg --mask mask.png", says="from mask")
    assert angles_deg(read_light_directions("calibration/light_directions.txt", 4)).max() < 1.5


def test_the_picture_shows_where_no_highlight_was_found(run):
    write_balls("dark", LIGHTS[:2])
    cv2.imwrite("dark/2.png", np.full(SIZE, 900, np.uint16))
    says = "dark/2.png: found no highlight in the ball. calibration/calibration.png shows the"
    run("calibrate dark --circle 60,48,40", code=3, says=says)
    assert [path.name for path in Path("calibration").iterdir()] == ["calibration.png"]
    assert cv2.imread("calibration/calibration.png").shape[1] == 600, "three images"
    Path("dark/2.png").unlink()
    run("calibrate dark --circle 60,48,40 --overwrite", says="from --circle")


def test_a_flat_disc_is_no_ball(run):
    """A lamp's image keeps its shape on a disc. A ball as evenly bright shortens it."""
    y, x = np.indices((240, 240)) - 119.5
    inside = np.hypot(x, y) < 90
    n = np.stack((x, -y, np.sqrt(np.where(inside, 90.0**2 - x * x - y * y, 0))), axis=-1) / 90
    for name in ("disc", "ball"):
        Path(name).mkdir()
        for number, half in enumerate(halfway(LIGHTS[1:])):
            flat = np.hypot(x / 90 - half[0], y / 90 + half[1])
            angle = np.arccos((n @ half).clip(-1, 1)) if name == "ball" else flat
            spot = np.exp(-((angle / 0.09) ** 2))
            picture = np.where(inside, 0.1 + 0.7 * spot, 0.02)
            write_image(Path(name) / f"{number}.png", to_uint16(picture * 65535))
    run("calibrate disc -o disc_lights", code=3, says="as on a flat disc. disc_lights/calibration")
    assert [path.name for path in Path("disc_lights").iterdir()] == ["calibration.png"]
    run("calibrate disc -o disc_lights --circle 119.5,119.5,90 --overwrite", says="from --circle")
    run("calibrate ball -o ball_lights", says="from picture")
    found = read_light_directions("ball_lights/light_directions.txt", 3)
    assert angle_between_deg(found, LIGHTS[1:]).max() < 1


def test_refusals(refuse):
    write_balls("ball")
    write_balls("short", LIGHTS[:3])
    write_balls("flat", wall=0.02)
    write_balls("cut")
    for path in Path("cut").iterdir():
        write_image(path, read_image(path)[:, 35:])
    write_gray([1, 1, 0, 1])
    Path("empty").mkdir()
    Path("nothing").mkdir()
    Path("nothing/0.pgm").write_bytes(b"P5\n0 0\n255\n")
    Path("done").mkdir()
    Path("done/calibration.png").touch()
    cases = """
        2
        2 ball --circle 60,48
        2 ball --circle 60,48,-3
        2 ball short --circle 60,48,40
        2 ball --gray-ball gray --gray-card gray
        3 missing
        3 empty
        3 nothing
        3 ball --mask nothing/0.pgm
        3 flat
        3 cut
        3 ball --circle 600,480,40
        3 ball short --circle 60,48,40 --circle 60,48,40
        3 ball --mask missing.png
        3 ball --circle 60,48,40 --gray-ball gray
        3 ball --circle 60,48,40 --gray-card short
        3 ball --circle 60,48,40 --compare missing.txt
        5 ball -o done
    """
    refuse("calibrate", cases)
    assert not Path("calibration").exists()


def test_a_display_encoded_target_is_reported(run):
    write_balls("ball")
    write_gray([1.0, 1.0, 1.0, 1.0])
    for path in Path("gray").glob("[0-9].png"):
        picture = read_image(path)
        write_image(path.with_suffix(".jpg"), np.uint8(picture // 257))
        path.unlink()
    arguments = "calibrate ball --circle 60,48,40 --gray-ball gray --overwrite"
    asked = run(f"{arguments} --transfer linear").err  # the option that the warning below names
    assert (
        "as requested by --transfer. Omit the option if" in asked and "Add --transfer" not in asked
    )
    intensities = []
    for curve in ("srgb", "auto"):
        run(f"{arguments} --transfer {curve}")
        intensities.append(Path("calibration/light_intensities.txt").read_text())
    assert intensities[0] == intensities[1]
    run(arguments, says="are read as sRGB. Add --transfer linear")
    assert "--transfer srgb reverses" not in run(f"{arguments} --transfer srgb").err
    run(arguments, says="The light intensities were written to calibration/light_intensities.txt\n")
    # Those of earlier lights are removed.
    run("calibrate ball --overwrite")
    assert not Path("calibration/light_intensities.txt").exists()
