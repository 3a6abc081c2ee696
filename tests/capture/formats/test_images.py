"""Photographs and masks: values exactly as written, and damaged files refused without a word on
stderr.

BMP, TGA and EXIF tags (exposures and orientations, one of each for all images) are written by
Pillow.
"""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageFile
from PIL.TiffImagePlugin import IFDRational

from scenes import parametrize, put, refuses, ring_lights, with_chunk, write_capture
from splinecli.capture import CaptureOptions, open_capture, read_image, read_mask
from splinecli.capture.formats.facts import (
    UPRIGHT,
    Exposure,
    ImageHeader,
    common_orientation,
    exposure_factors,
    find_exposure,
    read_header,
)
from splinecli.capture.formats.images import decode_image
from splinecli.recipe import read_capture
from splinecli.records import capture_warnings

RNG = default_rng(2)
RGB16 = RNG.integers(0, 65536, (7, 9, 3)).astype(np.uint16)
RGB8 = (RGB16 >> 8).astype(np.uint8)


@parametrize("name", "a.png a.tif A.TIFF")
@parametrize(
    "stored", [RGB16, RGB8, RGB16[..., 0], RGB8[..., 0]], ids=["rgb16", "rgb8", "gray16", "gray8"]
)
def test_integers_are_scaled_by_their_full_range(write_image, name, stored):
    image = read_image(write_image(name, stored))
    assert image.dtype == np.float32
    full = np.float32(np.iinfo(stored.dtype).max)
    assert_array_equal(image, np.float32(stored.reshape(7, 9, -1)) / full)


@parametrize("dtype", [np.float16, np.float32, np.float64])
@parametrize("channels", [1, 3])
def test_floating_point_tiff_is_kept(tmp_path, dtype, channels):
    stored = RNG.uniform(0, 5, (7, 9, channels)).astype(dtype)
    photometric = "rgb" if channels == 3 else "minisblack"
    tifffile.imwrite(tmp_path / "a.tif", stored.squeeze(), photometric=photometric)
    assert_array_equal(read_image(tmp_path / "a.tif"), np.float32(stored))


@parametrize(
    "options",
    [
        {"compression": "zlib"},
        {"compression": "zlib", "predictor": True},
        {"tile": (16, 16)},
        {"bigtiff": True},
    ],
    ids=["deflate", "predictor", "tiles", "bigtiff"],
)
def test_kinds_of_tiff(tmp_path, options):
    tifffile.imwrite(tmp_path / "a.tif", RGB16, photometric="rgb", **options)
    assert_array_equal(read_image(tmp_path / "a.tif"), RGB16 / np.float32(65535))


def test_planar_and_white_is_zero_tiff_and_alpha(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif", np.moveaxis(RGB16, 2, 0), photometric="rgb", planarconfig="separate"
    )
    bgra = np.dstack([RGB16[..., ::-1], np.uint16(RNG.integers(0, 65536, (7, 9)))])
    cv2.imwrite(str(tmp_path / "alpha.png"), bgra)
    cv2.imwrite(str(tmp_path / "alpha.tif"), bgra)
    for name in ("a.tif", "alpha.png", "alpha.tif"):
        assert_array_equal(read_image(tmp_path / name), RGB16 / np.float32(65535))
    tifffile.imwrite(tmp_path / "w.tif", 255 - RGB8[..., 0], photometric="miniswhite")
    assert_array_equal(read_image(tmp_path / "w.tif")[..., 0], RGB8[..., 0] / np.float32(255))


def test_jpeg_channels_and_exif_orientation(write_image):
    stored = np.zeros((16, 32, 3), np.uint8)
    stored[:, :16, 0] = 255  # red on the left
    stored[:, 16:, 2] = 255  # blue on the right
    path = write_image("a.jpg", stored)
    data = path.read_bytes()
    # An EXIF segment that asks for a turn by 90 degrees: one entry, tag 0x112, orientation 6.
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHII", 8, 1, 0x112, 3, 1, 6) + b"\0" * 4
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    # the segment works: by default OpenCV turns the image
    assert cv2.imread(str(path)).shape == (32, 16, 3)
    image = read_image(path)
    assert image.shape == (16, 32, 3)
    apart = np.r_[:14, 18:32]  # the chroma is subsampled, so the colours mix where they meet
    assert_allclose(image[:, apart], stored[:, apart] / 255, atol=0.05)  # JPEG's loss


@parametrize("name", "a.png a.jpg a.tif deflate.tif lzw.tif")
def test_truncated_and_damaged_images(tmp_path, write_image, capfd, name):
    large = RNG.integers(0, 256, (64, 64, 3)).astype(np.uint8)
    path = tmp_path / name
    if name == "deflate.tif":
        tifffile.imwrite(path, RGB16, compression="zlib")
    elif name == "a.tif":
        tifffile.imwrite(path, large)
    else:
        write_image(name, large)  # OpenCV's TIFF is LZW
    data = path.read_bytes()
    contents = [data[: int(len(data) * share)] for share in (0.05, 0.5, 0.95, 0.999)]
    if name == "a.tif":
        contents += [data[:size] for size in (0, 8, 9, 60, 100, 200, 1000, -10)]
    if name in ("a.png", "deflate.tif"):  # others have no checksums
        contents.append(data[: len(data) // 2] + bytes(30) + data[len(data) // 2 + 30 :])
    for content in contents:
        path.write_bytes(content)
        message = (
            r"is (truncated|damaged (and cannot be read|\(a checksum is wrong\)))\. Copy or export "
            r"it again\.|the file is empty"
        )
        with refuses(message) as caught:
            read_image(path)
        assert caught.value.path == path
    assert capfd.readouterr() == ("", "")


def test_the_c_library_is_silent_and_gamma_is_not_applied(write_image, capfd):
    path = write_image("a.png", RGB16)
    data = path.read_bytes()
    data = with_chunk(data, b"iCCP", b"x\0\0" + zlib.compress(b"no profile"))
    path.write_bytes(with_chunk(data, b"gAMA", struct.pack(">I", 45455)))
    assert_array_equal(read_image(path), RGB16 / np.float32(65535))
    assert capfd.readouterr() == ("", "")
    cv2.imread(str(path))
    # libpng does complain of this file when nobody holds its mouth
    assert "iCCP" in capfd.readouterr().err


NOT_FINITE = "a value that is not finite"


@parametrize(
    "value, found", [(np.nan, NOT_FINITE), (np.inf, NOT_FINITE), (-0.5, "the negative value -0.5")]
)
def test_values_no_photograph_has(tmp_path, value, found):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.array([[1, value]], np.float32))
    with refuses(rf"a\.tif: found {found}.*expected a photograph\.") as caught:
        read_image(path)
    assert ("Set negative values" in str(caught.value)) == (value == -0.5)


def test_files_that_are_no_such_image(tmp_path):
    (tmp_path / "empty.tif").touch()
    (tmp_path / "header.tif").write_bytes(b"II*\0\x08\0\0\0")
    tifffile.imwrite(tmp_path / "int.tif", RGB16.astype(np.int32), photometric="rgb")
    palette = np.zeros((3, 256), np.uint16)
    tifffile.imwrite(
        tmp_path / "palette.tif", RGB8[..., 0], photometric="palette", colormap=palette
    )
    for name, message in (
        (".", "found a folder, expected an image"),
        ("empty.tif", "the file is empty"),
        ("header.tif", "the TIFF is damaged and cannot be read"),
        ("int.tif", "found int32 pixels, expected 8-bit, 16-bit or floating-point pixels"),
        ("palette.tif", "colour model PALETTE, expected gray or RGB"),
    ):
        with refuses(message):
            read_image(tmp_path / name)


def test_mask(write_image):
    for stored, expected in (
        (np.array([[0, 1], [1, 0]], np.uint8), [[False, True], [True, False]]),
        (np.array([[0, 255], [127, 128]], np.uint8), [[False, True], [False, True]]),
        (np.array([[0, 65535]], np.uint16), [[False, True]]),
        (np.array([[[0, 0, 200], [90, 90, 90]]], np.uint8), [[True, False]]),
    ):
        mask = read_mask(write_image("mask.png", stored))
        assert mask.dtype == np.bool_
        assert_array_equal(mask, expected)


CUT_OUT = np.array([[0, 0, 255], [0, 200, 255]], np.uint8)


@parametrize("name", "mask.png mask.tif")
@parametrize("colour", [0, 90, 255])
def test_a_cut_out_is_a_mask_whatever_its_colours(tmp_path, name, colour):
    for alpha, scale in ((CUT_OUT, 1), (np.uint16(CUT_OUT) * 257, 257)):
        cv2.imwrite(
            str(tmp_path / name), np.dstack([np.full_like(alpha, colour * scale)] * 3 + [alpha])
        )
        assert_array_equal(read_mask(tmp_path / name), CUT_OUT > 127)
    # Alpha that cuts nothing out leaves the mask to the colours.
    for nothing in (np.full((2, 3), 255), np.zeros((2, 3)), [[255, 254, 255], [250, 255, 255]]):
        cv2.imwrite(
            str(tmp_path / name), np.dstack([CUT_OUT] * 3 + [np.asarray(nothing, np.uint8)])
        )
        assert_array_equal(read_mask(tmp_path / name), CUT_OUT > 127)


RGB = default_rng(0).integers(0, 256, (7, 5, 3), np.uint8)


@parametrize("suffix, options", [(".bmp", {}), (".tga", {}), (".tga", {"compression": "tga_rle"})])
@parametrize("mode, channels", [("RGB", 3), ("L", 1), ("P", 3)])
def test_pixels(tmp_path, suffix, options, mode, channels):
    picture = Image.fromarray(RGB).convert(mode)
    picture.save(tmp_path / f"image{suffix}", **options)
    path = tmp_path / f"image{suffix}"
    expected = np.asarray(picture.convert("RGB" if mode == "P" else mode)).reshape(7, 5, channels)
    assert_array_equal(decode_image(path), expected)
    facts = read_header(path)
    assert (
        facts.size == ((7, 5, channels), 1) and facts.curve.curve == 1 and facts.white_level is None
    )


@parametrize("suffix", ".bmp .tga")
def test_damage(tmp_path, suffix):
    path = tmp_path / f"image{suffix}"
    Image.fromarray(RGB).save(path)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:10], b"BM" + bytes(40)):
        path.write_bytes(content)
        with refuses(r"damaged|found an image|empty"):
            decode_image(path)


def test_pictures_that_are_no_photographs_are_left_out(tmp_path):
    pictures, lights = np.full((6, 4, 5), 100, np.uint8), ring_lights(6)
    folder = write_capture(tmp_path / "owl", pictures, lights, names="owl.{}.png")
    Image.fromarray(RGB).save(folder / "owl.mask.bmp")
    Image.fromarray(RGB).save(folder / "owl_normal.tga")
    capture = read_capture(folder)
    assert capture.n_lights == 6
    (found,) = [w for w in capture.warnings if w.kind == capture_warnings.IMAGES_LEFT_OUT]
    assert str(found).startswith("owl.mask.bmp and 1 more: left out")
    # If all of them have such names, these say nothing.
    assert (
        read_capture(
            write_capture(tmp_path / "a", pictures, lights, names="mask_of_a_king_{}.png")
        ).n_lights
        == 6
    )


def test_a_picture_of_another_size_without_a_light_is_left_out(tmp_path):
    folder = write_capture(tmp_path / "owl", np.full((6, 4, 5), 100, np.uint8), ring_lights(6))
    Image.fromarray(RGB[:2]).save(folder / "thumb.png")
    capture = read_capture(folder)
    assert capture.n_lights == 6
    assert capture.mask.shape == (4, 5)
    (found,) = [w for w in capture.warnings if w.kind == capture_warnings.IMAGES_LEFT_OUT]
    assert str(found).startswith(
        "thumb.png: left out, because light_directions.txt has no light for it"
    )
    Image.fromarray(np.full((4, 5), 100, np.uint8)).save(folder / "006.png")
    with refuses("found 6 light directions, expected 8"):
        read_capture(folder)


EXIF = 0x8769


def write(path, seconds=(1, 60), f_number=8.0, iso=100):
    image = Image.fromarray(np.full((6, 8, 3), 90, np.uint8))
    tags = Image.Exif()
    tags[0x010F] = "Maker"  # without any tag of its own Pillow leaves all out
    if seconds is not None:
        tags.get_ifd(EXIF).update({0x829A: IFDRational(*seconds), 0x829D: f_number, 0x8827: iso})
    image.save(path, exif=tags)
    return path


def capture(folder, *exposures):
    folder.mkdir(exist_ok=True)
    for number, seconds in enumerate(exposures):
        write(folder / f"{number}.jpg", seconds)
    put(folder / "lights.txt", "0 0 1\n0.5 0 1\n0 0.5 1\n")
    return folder


def test_reading(tmp_path):
    for suffix in ("jpg", "png"):
        assert find_exposure(read_header(write(tmp_path / f"a.{suffix}"))) == Exposure(
            1 / 60, 8.0, 100
        )
        assert find_exposure(read_header(write(tmp_path / f"b.{suffix}", None))) is None


@parametrize(
    ("shot", "kept"),
    [
        ((1e-300, 8, 100), None),
        ((0.1, 1e200, 100), Exposure(0.1, None, 100)),
        ((0.1, 8, 1e300), Exposure(0.1, 8, None)),
    ],
)
def test_values_that_no_camera_has_count_as_missing(shot, kept):
    """EXIF may store them as doubles."""
    facts = ImageHeader(Path("a.tif"), exif=dict(zip((0x829A, 0x829D, 0x8827), shot, strict=True)))
    assert find_exposure(facts) == kept and exposure_factors([facts, facts]) is None


def test_mixed_exposures_are_divided_out(tmp_path):
    folder = capture(tmp_path / "mixed", (1, 60), (1, 60), (1, 30))
    for options in ({}, {"intensities": "equal"}):  # equal lamps do not make equal exposures
        source = open_capture(folder, CaptureOptions(**options))
        # The third image got twice the light of the others; the mean is 4 / 3.
        assert_allclose(source.light_intensities[:, 1], [0.75, 0.75, 1.5])
        assert (source.intensities_known, source.intensities_measured) == (bool(options), False)
        assert source.warnings[0].code == "exif_exposure"
        assert "from 1/60 s, f/8, ISO 100 to 1/30 s, f/8, ISO 100." in str(source.warnings[0])
    write(folder / "1.jpg", None)
    message = (
        r"2\.jpg: found an exposure of 1/30 s, f/8, ISO 100, expected 1/60 s, f/8, ISO 100 as in "
        r"0\.jpg"
    )
    with refuses(message):
        open_capture(folder)
    # Intensities say how the images compare.
    put(folder / "light_intensities.txt", "1\n1\n2\n")
    assert open_capture(folder).n_lights == 3


def test_exposures_that_are_one(tmp_path):
    open_capture(capture(tmp_path / "rounded", (1, 60), (10, 610), None))
    folder = capture(tmp_path / "balanced", (1, 60), (1, 60), (1, 60))
    write(folder / "1.jpg", (1, 120), iso=200)
    open_capture(folder)
    write(folder / "1.jpg", (1, 60), iso=0)  # incomparable
    open_capture(folder)


def test_manual_lenses_state_no_aperture(tmp_path):
    folder = capture(tmp_path / "manual")
    for number, seconds in enumerate(((1, 60), (1, 60), (1, 30))):
        write(folder / f"{number}.jpg", seconds, f_number=0)
    assert "from 1/60 s, ISO 100 to 1/30 s, ISO 100." in str(open_capture(folder).warnings[0])


def turned(folder, name, orientation):
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    Image.new("L", (4, 3), 90).save(folder / name, exif=exif)
    return folder / name


@parametrize("tag, expected", [(None, UPRIGHT), (1, UPRIGHT), (6, 6), (42, UPRIGHT)])
def test_one_orientation(tmp_path, monkeypatch, tag, expected):
    """The pixels are not decoded, which takes seconds for 24 megapixels."""
    images = [
        turned(tmp_path, "a.jpg", tag),
        turned(tmp_path, "b.tif", tag),
        turned(tmp_path, "c.png", tag),
    ]
    monkeypatch.setattr(ImageFile.ImageFile, "load", None)
    assert common_orientation([read_header(image) for image in images]) == expected


def test_different_orientations_are_refused(tmp_path):
    images = [
        turned(tmp_path, "a.jpg", None),
        turned(tmp_path, "b.jpg", 1),
        turned(tmp_path, "c.jpg", 8),
    ]
    with refuses(r"c\.jpg: found EXIF orientation 8, expected 1 as in a\.jpg"):
        common_orientation([read_header(image) for image in images])
