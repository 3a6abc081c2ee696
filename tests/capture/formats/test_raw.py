"""RAW files: DNGs written here, of known radiance, so that what LibRaw makes of them is known
too.
"""

import struct
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenes import codes, parametrize, put, refuses
from splinecli.capture import open_capture
from splinecli.capture.formats.facts import Exposure, find_exposure, read_header
from splinecli.capture.formats.images import decode_image
from splinecli.recipe import read_capture

WHITE = 16383
BAYER = (0, 1, 1, 2)  # R G / G B
SHOT = (1 / 64, 8.0, 100)
LIGHTS = "0 0 1\n0.5 0 1\n0 0.5 1\n"


needs_rawpy = pytest.mark.skipif(find_spec("rawpy") is None, reason="needs rawpy")


@pytest.fixture
def without_rawpy(monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)


def directory(entries, start):
    """A little-endian TIFF directory at byte `start`: (tag, type, values), r and R for (un)signed
    rationals.
    """
    kinds = {"B": 1, "s": 2, "H": 3, "I": 4, "R": 5, "r": 10}
    after = start + 2 + 12 * len(entries) + 4
    head, tail = struct.pack("<H", len(entries)), b""
    for tag, kind, values in sorted(entries):
        if kind == "s":
            data, count = values.encode() + b"\0", len(values) + 1
        elif kind in "Rr":
            pair = "<ii" if kind == "r" else "<II"
            data, count = (
                b"".join(struct.pack(pair, round(v * 64e4), 640_000) for v in values),
                len(values),
            )
        else:
            data, count = struct.pack(f"<{len(values)}{kind}", *values), len(values)
        head += struct.pack("<HHI", tag, kinds[kind], count)
        if len(data) <= 4:
            head += data.ljust(4, b"\0")
        else:
            head += struct.pack("<I", after + len(tail))
            tail += data + b"\0" * (len(data) % 2)
    return head + bytes(4) + tail


def write_dng(
    path,
    sensor,
    *,
    white=WHITE,
    black=(0, 0, 0, 0),
    neutral=(0.5, 1.0, 0.6),
    orientation=1,
    exposure=None,
    magic=b"II*\0",
):
    """A DNG of sensor values (H, W) behind a Bayer filter, or (H, W, C) without; black of its four
    places.
    """
    bayer = sensor.ndim == 2
    pixels, samples = sensor.astype("<u2").tobytes(), 1 if bayer else sensor.shape[2]

    def tags(exif, at):
        return [
            (254, "I", [0]),
            (256, "I", [sensor.shape[1]]),
            (257, "I", [sensor.shape[0]]),
            (258, "H", [16] * samples),
            (259, "H", [1]),
            (262, "H", [32803 if bayer else 34892]),
            (271, "s", "Nobody"),
            (272, "s", "Made Up"),
            (273, "I", [at]),
            (274, "H", [orientation]),
            (277, "H", [samples]),
            (278, "I", [sensor.shape[0]]),
            (279, "I", [len(pixels)]),
            (50706, "B", [1, 4, 0, 0]),
            (50708, "s", "Nobody Made Up"),
            (50717, "H", [white] * samples),
            (50721, "r", [0.9, -0.3, -0.1, -0.4, 1.2, 0.2, -0.1, 0.2, 0.6]),
            (50728, "R", neutral),
            (50778, "H", [21]),
            *(
                [
                    (33421, "H", [2, 2]),
                    (33422, "B", BAYER),
                    (50713, "H", [2, 2]),
                    (50714, "H", black),
                ]
                if bayer
                else []
            ),
            *([] if exposure is None else [(34665, "I", [exif])]),
        ]

    exif = 8 + len(directory(tags(0, 0), 8))
    shot = b""
    if exposure is not None:
        seconds, f_number, iso = exposure
        shot = directory(
            [(33434, "R", [seconds]), (33437, "R", [f_number]), (34855, "H", [iso])], exif
        )
    at = exif + len(shot)
    path.write_bytes(magic + struct.pack("<I", 8) + directory(tags(exif, at), 8) + shot + pixels)
    return path


def mosaic(light, *, white=WHITE, black=(0, 0, 0, 0)):
    """What the sensor stores (H, W) of light (H, W) or (H, W, 3), 1 where it saturates."""
    y, x = np.indices(light.shape[:2]) % 2
    if light.ndim == 3:
        light = np.take_along_axis(light, np.array(BAYER).reshape(2, 2)[y, x][..., None], 2)[..., 0]
    dark = np.array(black).reshape(2, 2)[y, x]
    return np.uint16(np.clip(np.round(dark + light * (white - dark)), 0, white))


def ramp(height=30, width=80):
    return np.broadcast_to(np.linspace(0.01, 0.45, width), (height, width)).copy()


@needs_rawpy
@parametrize("black", [(0, 0, 0, 0), (512, 512, 512, 512), (512, 516, 514, 509)])
def test_values_are_proportional_to_light(tmp_path, black):
    light = ramp()
    once, twice = (
        decode_image(write_dng(tmp_path / f"{k}.dng", mosaic(k * light, black=black), black=black))
        for k in (1, 2)
    )
    assert once.shape == (*light.shape, 3) and once.dtype == np.uint16
    # The borders of a bilinear interpolation are no ramp. Rounding on the sensor is 1/2 of 16383,
    # and its full scale is that of the highest black level: half a thousandth.
    inner = (slice(2, -2), slice(2, -2))
    assert_allclose(once[inner] / 65535, light[inner][..., None] * np.ones(3), rtol=1e-3, atol=1e-4)
    bright = once[inner] > 2000
    assert_allclose(twice[inner][bright] / once[inner][bright], 2, rtol=0.01)


@needs_rawpy
def test_white_balance_and_orientation_of_the_shot_do_not_count(tmp_path):
    sensor = mosaic(ramp())
    first = decode_image(write_dng(tmp_path / "a.dng", sensor))
    for number, (neutral, orientation) in enumerate([((0.9, 1.0, 0.3), 1), ((0.5, 1.0, 0.6), 6)]):
        other = write_dng(
            tmp_path / f"{number}.dng", sensor, neutral=neutral, orientation=orientation
        )
        assert_array_equal(decode_image(other), first)


@needs_rawpy
# In single precision, 4095 * (65535 / 4095) is 65534.996; levels of 16383 and 600 give 65534.
@parametrize(
    "white, black",
    [(16383, (0,) * 4), (4095, (0,) * 4), (16383, (600,) * 4), (15000, (512, 530, 520, 500))],
)
def test_saturated_photosites_are_at_full_scale(tmp_path, white, black):
    light = np.full((40, 60), 0.98)
    light[10:20, 10:20] = 1
    light[25:35, 10:20] = 3
    for number, dimmed in enumerate((light, np.where(light < 1, 0.3, light))):
        levels = {"white": white, "black": black}
        pixels = decode_image(
            write_dng(tmp_path / f"{number}.dng", mosaic(dimmed, **levels), **levels)
        )
        assert (pixels[11:19, 11:19] == 65535).all() and (pixels[26:34, 11:19] == 65535).all()
        assert (pixels[:, 30:] < 65535).all()


@needs_rawpy
@parametrize("colour", [(0.2, 0.5, 0.3), (0.4,)])
def test_channels_are_red_green_blue_of_the_camera_and_sensors_without_bayer_filter(
    tmp_path, colour
):
    light = np.broadcast_to(colour, (30, 40, len(colour)))
    pixels = decode_image(write_dng(tmp_path / "a.dng", np.round(light * WHITE)))
    assert pixels.shape == light.shape
    assert_allclose(pixels / 65535, light, atol=1e-4)
    filtered = decode_image(
        write_dng(tmp_path / "b.dng", mosaic(np.broadcast_to(colour, (30, 40, 3))))
    )
    assert_allclose(filtered[10, 10] / 65535, np.broadcast_to(colour, 3), atol=1e-4)


@pytest.mark.usefixtures("without_rawpy")
def test_rawpy_is_asked_for(tmp_path):
    path = write_dng(tmp_path / "a.nef", mosaic(ramp()))
    with refuses(r"a\.nef: .* need rawpy, .*pip install 'splinecli\[raw\]', or export .* TIFF"):
        decode_image(path)


@needs_rawpy
def test_damaged_files(tmp_path, capfd):
    whole = write_dng(tmp_path / "whole.dng", mosaic(ramp())).read_bytes()
    for kept in (10, 200, 600, 3000):
        (tmp_path / "cut.dng").write_bytes(whole[:kept])
        with refuses(r"cut\.dng: the RAW file is damaged"):
            decode_image(tmp_path / "cut.dng")
    assert capfd.readouterr() == ("", "")


def test_one_file_of_each_photograph_counts(tmp_path):
    """Ambient images may be RAW, masks not."""
    names = "img2.NEF IMG2.jpg img10.nef img10.tif img10.jpg img3.png img3.jpg notes.txt"
    for name in f"{names} ambient.NEF ambient.jpg mask.nef mask.png".split():
        (tmp_path / name).touch()
    put(tmp_path / "lights.txt", LIGHTS)
    source = open_capture(tmp_path)
    # Of img2 the RAW file and not the camera's copy, of img10 what was developed, of img3 the PNG.
    assert [image.name for image in source.files.images] == ["img2.NEF", "img3.png", "img10.tif"]
    assert source.files.ambient == tmp_path / "ambient.NEF"
    assert source.files.mask == tmp_path / "mask.png"
    assert "ambient.NEF was subtracted from all images as ambient light." in map(
        str, source.warnings
    )


@pytest.mark.usefixtures("without_rawpy")
def test_exposure_in_a_tiff_header_needs_no_rawpy(tmp_path):
    stated = write_dng(tmp_path / "a.dng", mosaic(ramp()), exposure=SHOT)
    assert find_exposure(read_header(stated)) == Exposure(*SHOT)
    assert find_exposure(read_header(write_dng(tmp_path / "b.dng", mosaic(ramp())))) is None
    # The header of Olympus.
    other = write_dng(tmp_path / "c.orf", mosaic(ramp()), exposure=SHOT, magic=b"IIRO")
    assert find_exposure(read_header(other)) is None
    assert read_header(stated).curve.curve == 1


@needs_rawpy
def test_exposure_in_another_header(tmp_path, capfd):
    path = write_dng(tmp_path / "a.orf", mosaic(ramp()), exposure=SHOT, magic=b"IIRO")
    assert find_exposure(read_header(path)) == Exposure(*SHOT)
    path.write_bytes(path.read_bytes()[:2000])
    assert find_exposure(read_header(path)) is None
    assert capfd.readouterr() == ("", "")


@needs_rawpy
@parametrize("thumbnail", [False, True])
def test_the_white_level_is_that_of_the_developed_values(tmp_path, thumbnail):
    """The tags say 4095 of the sensor's values, or 8 bits of a thumbnail; the values read end at
    65535.
    """
    light = np.broadcast_to(np.linspace(0.02, 0.6, 80), (30, 80))  # up to 39321, far above 4095
    for number in range(3):
        path = write_dng(tmp_path / f"{number}.dng", mosaic(light, white=4095), white=4095)
        if thumbnail:  # one value for the first picture, as cameras store; LibRaw reads the others
            tags = [struct.pack("<HHIHH", 258, 3, 1, bits, 0) for bits in (16, 8)]
            path.write_bytes(path.read_bytes().replace(*tags))
        assert read_header(path).white_level == 65535
    put(tmp_path / "lights.txt", LIGHTS)
    if not thumbnail:
        capture = read_capture(tmp_path)
        assert capture.white_level is not None and capture.white_level.value == 65535
        assert capture.restored is None and "saturated" not in set(codes(capture))
