"""The camera of a calibration, from EXIF tags: focal lengths computed by hand."""

import numpy as np
from PIL import Image

from scenes import parametrize, put
from splinecli.capture.formats.facts import read_header
from splinecli.lights.calibration.balls import DISTANT, find_view


def photograph(path, tags):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("L", (360, 240)).save(path, exif=exif)
    return path


@parametrize(
    ("tags", "focal"),
    [
        ({0xA405: 50}, 500),  # 36 mm are 360 pixels
        ({0x920A: 50.0, 0xA20E: 254.0, 0xA210: 2}, 500),  # 254 pixels in an inch
        ({0x920A: 50.0, 0xA20E: 100.0, 0xA210: 3}, 500),
        ({0x920A: 50.0, 0xA20E: 1000.0, 0xA210: 3, 0xA002: 3600}, 500),  # scaled to a tenth
        ({0x920A: 50.0, 0xA20E: 0.0, 0xA405: 50}, 500),
        ({}, DISTANT),
        ({0x920A: 50.0}, DISTANT),
        ({0xA405: 0}, DISTANT),
    ],
)
def test_focal_lengths(tmp_path, tags, focal):
    view = find_view(read_header(photograph(tmp_path / "a.jpg", tags)), None)
    assert view.source == ("assumed distant" if focal == DISTANT else "EXIF")
    np.testing.assert_allclose(
        view.matrix, ((focal, 0, 179.5), (0, focal, 119.5), (0, 0, 1)), rtol=1e-6
    )


def test_a_file_comes_first(tmp_path):
    image = photograph(tmp_path / "a.jpg", {0xA405: 50})
    put(tmp_path / "m.txt", "700 0 180\n0 710 120\n0 0 1\n")
    assert find_view(read_header(image), tmp_path / "m.txt").matrix[1, 1] == 710
