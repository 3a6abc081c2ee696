"""`splinecli info`: its report of a capture whose content is known, and that it writes nothing."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from pytest import approx

from scenes import pinhole, read_image, spiral_lights, to_uint16, write_capture, write_image
from splinecli.estimate.networks.weights import manifest


def test_the_report_of_a_capture(run, capture):
    before = sorted(Path().rglob("*"))
    result = run(f"info {capture}")
    assert sorted(Path().rglob("*")) == before
    rows = {line[:13].strip(): line[13:] for line in result.out.splitlines()}
    assert rows["capture"] == f"{capture.name} (plain folder)"
    assert rows["images"] == "8 (image1.png ... image8.png): 24 x 24, gray, 16 bits"
    # (+-0.4, +-0.4, 1) are the lowest lights, 29.5 degrees from the view axis.
    assert rows["lights"].endswith("light_directions.txt, 0 to 30 degrees from the camera axis")
    assert rows["mask"].endswith("mask.png (448 pixels)")
    assert rows["intensities"].startswith("none")
    assert rows["white level"] == "65535, the full scale of the files"


def test_the_same_as_json(document, capture):
    report = document(f"info {capture}")
    assert report["image_kinds"] == [{"size": [24, 24], "channels": 1, "type": "uint16"}]
    assert report["axis_angle_deg"] == [0.0, 29.5]
    assert report["light_intensities"] is None
    assert report["exposure"]["saturated"] == 0
    # 60000 of 65535 under the light from the camera, at the top of the sphere.
    assert report["exposure"]["bright"][1] == approx(60_000 / 65_535, abs=0.01)
    assert report["warnings"] == []
    assert report["weights"]["cnn-ps"] == manifest()["cnn-ps"]["sha256"]
    assert len(report["weights"]) == 6


def test_few_lights_near_the_axis(run, document, truth):
    lights = spiral_lights(6, 20)
    images = to_uint16(np.moveaxis(truth @ lights.T, 2, 0).clip(0) * 60_000)
    write_capture(Path("near"), images, lights, mask=truth[..., 2] > 0.3)
    warnings = [
        "There are 6 lights; use 8 or more, well spread.",
        "All lights are within 25 degrees of the camera axis; lower lights give better normals.",
    ]
    assert document("info near")["warnings"] == warnings
    assert [
        line.partition("near: ")[2] for line in run("infer near --method ls").err.splitlines()
    ] == warnings


def test_the_camera_of_exif(run, document):
    """A lens of 50 mm on film of 43.3 mm across the diagonal, before 36 x 24 mm in 360 x 240
    pixels.
    """
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 50
    Path("photographs").mkdir()
    for number in range(4):
        Image.new("L", (360, 240), 40 + 20 * number).save(f"photographs/{number}.jpg", exif=exif)
    np.savetxt("photographs/light_directions.txt", spiral_lights(4))
    report = document("info photographs")
    assert report["camera_matrix"] is None
    assert report["exif_camera_matrix"] == pinhole(500, 179.5, 119.5).tolist()
    words = (
        "treated as orthographic; EXIF suggests a --camera-matrix with the rows 500 0 179.5, 0"
        " 500 119.5, 0 0 1"
    )
    assert f"camera       {words}" in run("info photographs").out


def test_the_plot_of_the_lights(run, capture):
    run(f"info {capture} --plot sky.png -q")
    picture = cv2.imread("sky.png")
    orange = (np.abs(picture.astype(int) - (0x00, 0x5E, 0xD5)).sum(axis=2) < 20).sum()
    assert orange > 8 * 20  # eight markers


def test_warnings(run, capture):
    photographs = sorted(capture.glob("image*.png"))
    stored = read_image(photographs[0])
    write_image(photographs[0], np.uint8(stored // 256))
    write_image(photographs[1], np.full_like(stored, 65_535))
    write_image(photographs[2], stored // 30)
    warnings = run(f"info {capture!s} --json").json["warnings"]
    words = ("image2.png (100.0 %)", "8 bits", "5 % of the range, such as image3.png")
    assert all(word in warning for word, warning in zip(words, warnings[:3], strict=True))
    write_image(photographs[3], stored[:20])
    run(
        f"info {capture!s} --json",
        input_error="image4.png: found an image of 24 x 20 pixels, expected 24 x 24",
    )


def test_the_plot_replaces_no_photograph(run, capture):
    for name in ("image1.png", "sky.png"):
        run(
            f"info {capture} --plot {capture / name}",
            usage_error="would be read as an image of the capture",
        )
    Path("mine.png").write_bytes(b"mine")
    run(f"info {capture} --plot mine.png", code=5)
    assert Path("mine.png").read_bytes() == b"mine"
    run(f"info {capture} --plot mine.png --overwrite")


def test_the_white_level_of_12_bit_data(run, document, capture):
    """Clipped at 4095, no value reaches the full scale of the files, and yet many are saturated."""
    for path in capture.glob("image*.png"):
        stored = read_image(path).astype(float)
        write_image(path, np.uint16(np.minimum(stored * 1.2 / 16, 4095)))
    assert "white level  4095, found in the images\n" in run(f"info {capture}").out
    report = document(f"info {capture}")
    mask = read_image(capture / "mask.png") > 0
    shares = [(read_image(path)[mask] == 4095).mean() for path in capture.glob("image*.png")]
    assert max(shares) > 0.1 and report["exposure"]["saturated"] == approx(max(shares), abs=1e-4)
    assert report["exposure"]["bright"][1] == approx(1)


def test_auto_mask(document, capture):
    (capture / "mask.png").unlink()
    for path in capture.glob("image*.png"):
        stored = read_image(path)
        stored[:, :8] = 0
        write_image(path, stored)
    report = document(f"info {capture} --auto-mask")
    assert report["mask"] == "found in the images"
    assert report["n_pixels"] == 24 * 16


def test_the_contact_sheet_is_that_of_infer(capture, run, document):
    """A picture that is left out is on it, too."""
    write_image(capture / "photo_albedo.png", np.zeros((9, 9), np.uint8))
    report = document(f"infer {capture} --method ls --html")
    assert "capture.png" in report["files"]
    assert "The images as they are used" in Path(report["folder"], "page.html").read_text()
    run(f"info {capture} -o seen")
    seen = Path("seen", report["capture"], "capture.png").read_bytes()
    assert seen == Path(report["folder"], "capture.png").read_bytes()
    run(f"info {capture} -o seen", code=5, says="--overwrite")
