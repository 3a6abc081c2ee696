"""Transfer curves: sRGB at known values, and profiles written here after ISO 15076-1, and one of
LittleCMS.
"""

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import tifffile
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageCms

from scenes import codes, parametrize, put, refuses, with_chunk
from splinecli.capture import open_capture
from splinecli.capture.formats.facts import StatedCurve, read_header
from splinecli.errors import UsageError
from splinecli.maths.transfer import decode_transfer, encode_srgb, parse_transfer, profile_curve
from splinecli.recipe import read_capture

SRGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
STORED = np.float32(np.linspace(0, 1, 1001))
PIXELS = np.uint16(np.indices((9, 11)).sum(axis=0)[..., None] * (500, 700, 900) + 3000)


def curv(*numbers):
    return b"curv" + bytes(4) + struct.pack(f">I{len(numbers)}H", len(numbers), *numbers)


def para(kind, *numbers):
    fixed = (round(65536 * number) for number in numbers)
    return b"para" + bytes(4) + struct.pack(f">HH{len(numbers)}i", kind, 0, *fixed)


def profile(*curves, space=b"RGB ", name="Made up"):
    """A profile with one curve for each channel, or the same one for all."""
    names = (b"kTRC",) if space == b"GRAY" else (b"rTRC", b"gTRC", b"bTRC")
    text = name.encode("utf-16-be")
    tags = [
        (b"desc", b"mluc" + bytes(4) + struct.pack(">II4sII", 1, 12, b"enUS", len(text), 28) + text)
    ]
    tags += [(name, curves[min(i, len(curves) - 1)]) for i, name in enumerate(names)]
    table, data, at = b"", b"", 132 + 12 * len(tags)
    for tag, content in tags:
        table += tag + struct.pack(">II", at + len(data), len(content))
        data += content
    return (
        bytes(16)
        + space
        + bytes(16)
        + b"acsp"
        + bytes(88)
        + struct.pack(">I", len(tags))
        + table
        + data
    )


def write(path, icc, pixels=PIXELS):
    if path.suffix == ".tif":
        tifffile.imwrite(path, pixels, photometric="rgb", iccprofile=icc)
    elif path.suffix == ".jpg":
        Image.fromarray(np.uint8(pixels // 257)).save(path, icc_profile=icc)
    else:
        png = cv2.imencode(".png", pixels[..., ::-1])[1].tobytes()
        if icc is not None:
            png = with_chunk(png, b"iCCP", b"p\0\0" + zlib.compress(icc))
        path.write_bytes(png)
    return path


SRGB_PARAMETERS = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


@parametrize(
    "icc, expected",
    [
        (SRGB_PROFILE, None),
        (profile(para(3, *SRGB_PARAMETERS)), None),
        (profile(para(4, *SRGB_PARAMETERS, 0, 0)), None),
        (profile(curv(*np.rint(65535 * decode_transfer(STORED, None)).astype(int))), None),
        (profile(curv()), 1.0),
        (profile(curv(256)), 1.0),
        (profile(curv(0, 65535)), 1.0),
        (profile(curv(563)), 2.1992),
        (profile(para(0, 1.8)), 1.8),
        (profile(curv(461), space=b"GRAY"), 1.8008),
    ],
)
def test_curves_with_a_name(icc, expected):
    found = profile_curve(icc)
    assert found is not None and found[1] == expected


@parametrize(
    "curve, expected",
    [
        (para(1, 2, 0.9, 0.1), lambda x: (0.9 * x + 0.1) ** 2),
        (para(2, 2, 0.8, 0.1, 0.05), lambda x: (0.8 * x + 0.1) ** 2 + 0.05),
        (curv(0, 10_000, 65_535), lambda x: np.interp(x, (0, 0.5, 1), (0, 10_000 / 65_535, 1))),
    ],
)
def test_curves_without_a_name(curve, expected):
    found = profile_curve(profile(curve))
    assert found is not None and isinstance(found[1], tuple)
    assert_allclose(decode_transfer(STORED, found[1]), expected(STORED), atol=2e-4)


@parametrize(
    "icc",
    [
        b"",
        b"no profile",
        SRGB_PROFILE[:200],
        profile(b"mft2" + bytes(40)),
        profile(curv(256), curv(500)),  # one curve for each channel
        profile(curv(256), space=b"CMYK"),
        profile(curv(20), curv(20)),
        profile(para(9, 1)),
        profile(para(3, 2.4, 0, 0, 1, 0.5)),
        profile(curv(65535, 0)),
        profile(b"curv" + bytes(4) + struct.pack(">I", 1 << 31)),
        bytes(36) + b"acsp" + bytes(88) + b"\xff" * 4,
    ],
)
def test_profiles_without_a_usable_curve(icc):
    assert profile_curve(icc) is None


@parametrize("suffix", ".png .jpg .tif")
def test_profiles_in_files(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    by = 'colour profile "Made up"'
    assert read_header(write(path, profile(curv(563)))).curve == StatedCurve(2.1992, by)
    assert read_header(write(path, profile(curv(256), name="M\x1bade up"))).curve == StatedCurve(
        1.0, by
    )
    stated = read_header(write(path, b"no profile")).curve
    assert stated.unread and stated.curve == (None if suffix == ".jpg" else 1.0)
    assert not read_header(write(path, None)).curve.unread


@parametrize("suffix", ".png .jpg .tif")
def test_a_huge_profile_counts_as_none(tmp_path, suffix):
    path = write(tmp_path / f"a{suffix}", bytes(12 << 20))  # in a PNG, 12 kB that expand
    tracemalloc.start()
    assert read_header(path).curve.unread
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


def test_many_parts_in_a_jpeg(tmp_path):
    part = b"\xff\xe2" + struct.pack(">H", 65_535) + b"ICC_PROFILE\0\1\1"
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8" + (part + bytes(65_535 - 16)) * 100)
    assert read_header(tmp_path / "a.jpg").curve == StatedCurve(None, "JPEG", unread=True)


def capture(folder, icc, pixels, suffix):
    folder.mkdir()
    for number in range(4):
        write(folder / f"{number}{suffix}", icc, np.uint16(pixels * (1 - number / 10)))
    put(folder / "lights.txt", "0 0 1\n0.5 0 1\n0 0.5 1\n-0.5 0 1\n")
    return folder


@parametrize("suffix", ".png .tif")
def test_a_capture_is_read_with_the_curve_of_its_profile(tmp_path, suffix):
    adobe = capture(tmp_path / "adobe", profile(curv(563), name="Adobe RGB (1998)"), PIXELS, suffix)
    found = read_capture(adobe)
    linear = read_capture(
        capture(tmp_path / "linear", profile(curv(256)), PIXELS, suffix), as_stored=True
    )
    assert "display_decoded" not in codes(linear)
    plain = read_capture(capture(tmp_path / "plain", None, PIXELS, suffix), as_stored=True)
    assert_array_equal(linear.observations, plain.observations)
    expected = np.mean((PIXELS.reshape(-1, 3) / 65535) ** 2.1992, axis=1)
    assert_allclose(found.observations[:, 0], expected, rtol=1e-5)
    (told,) = [str(warning) for warning in found.warnings if warning.code == "display_decoded"]
    assert (
        '(colour profile "Adobe RGB (1998)") and are read as gamma:2.1992. Add --transfer linear'
        in told
    )


def test_profiles_that_differ_or_cannot_be_read(tmp_path):
    folder = capture(tmp_path / "a", SRGB_PROFILE, PIXELS, ".png")
    write(folder / "2.png", profile(curv(563)))
    source = open_capture(folder)
    assert source.radiometry.curve == 1
    assert codes(source) == ["display_encoded"]
    unread = open_capture(capture(tmp_path / "b", profile(b"mft2" + bytes(40)), PIXELS, ".png"))
    (warning,) = unread.warnings
    assert "The colour profile of 0.png was ignored" in str(warning) and "Add --transfer" in str(
        warning
    )


def test_srgb():
    # Half of the codes is 0.2159 of the light; 18 % gray is 118; what lies outside 0 to 1 is cut
    # off.
    values = np.array([0, 0.001, 0.18, 0.2159, 0.5, 1, -1, 3])
    assert encode_srgb(values).tolist() == [0, 3, 118, 128, 188, 255, 0, 255]


def test_decoding_turns_encoding_back():
    codes = np.arange(256)
    assert encode_srgb(decode_transfer(np.float32(codes / 255), None)).tolist() == codes.tolist()
    assert_allclose(decode_transfer(np.float32([0.25, 0.5]), 2.0), [0.0625, 0.25])


def test_names_of_curves():
    assert [parse_transfer(text) for text in ("auto", "linear", "srgb", "gamma:2.2")] == [
        1.0,
        1.0,
        None,
        2.2,
    ]
    for text in ("", "sRGB", "gamma", "gamma:", "gamma:0", "gamma:1.2.3", "gamma:99"):
        with refuses(r"expected auto, linear, srgb, or gamma:G with G from 0\.1 to 10", UsageError):
            parse_transfer(text)
