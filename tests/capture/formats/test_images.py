"""Photographs and masks: values exactly as written, and damaged files refused without a word on stderr."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from capture.conftest import WriteImage
from scenes import with_chunk
from splinecli.capture import read_image, read_mask
from splinecli.errors import InputError

RNG = np.random.default_rng(2)
RGB16 = RNG.integers(0, 65536, (7, 9, 3)).astype(np.uint16)
RGB8 = (RGB16 >> 8).astype(np.uint8)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "A.TIFF"])
@pytest.mark.parametrize("stored", [RGB16, RGB8, RGB16[..., 0], RGB8[..., 0]], ids=["rgb16", "rgb8", "gray16", "gray8"])
def test_integers_are_scaled_by_their_full_range(write_image, name, stored):
    image = read_image(write_image(name, stored))
    assert image.dtype == np.float32
    full = np.float32(np.iinfo(stored.dtype).max)
    np.testing.assert_array_equal(image, stored.reshape(7, 9, -1).astype(np.float32) / full)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("channels", [1, 3])
def test_floating_point_tiff_is_kept(tmp_path: Path, dtype: type, channels: int) -> None:
    stored = RNG.uniform(0, 5, (7, 9, channels)).astype(dtype)
    photometric = "rgb" if channels == 3 else "minisblack"
    tifffile.imwrite(tmp_path / "a.tif", stored.squeeze(), photometric=photometric)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), stored.astype(np.float32))


@pytest.mark.parametrize(
    "options",
    [{"compression": "zlib"}, {"compression": "zlib", "predictor": True}, {"tile": (16, 16)}, {"bigtiff": True}],
    ids=["deflate", "predictor", "tiles", "bigtiff"],
)
def test_kinds_of_tiff(tmp_path: Path, options: dict[str, object]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", RGB16, photometric="rgb", **options)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), RGB16 / np.float32(65535))


def test_planar_and_white_is_zero_tiff_and_alpha(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.moveaxis(RGB16, 2, 0), photometric="rgb", planarconfig="separate")
    bgra = np.dstack([RGB16[..., ::-1], RNG.integers(0, 65536, (7, 9)).astype(np.uint16)])
    cv2.imwrite(str(tmp_path / "alpha.png"), bgra)
    cv2.imwrite(str(tmp_path / "alpha.tif"), bgra)
    for name in ("a.tif", "alpha.png", "alpha.tif"):
        np.testing.assert_array_equal(read_image(tmp_path / name), RGB16 / np.float32(65535))
    tifffile.imwrite(tmp_path / "w.tif", 255 - RGB8[..., 0], photometric="miniswhite")
    np.testing.assert_array_equal(read_image(tmp_path / "w.tif")[..., 0], RGB8[..., 0] / np.float32(255))


def test_jpeg_channels_and_exif_orientation(write_image: WriteImage) -> None:
    stored = np.zeros((16, 32, 3), np.uint8)
    stored[:, :16, 0] = 255  # red on the left
    stored[:, 16:, 2] = 255  # blue on the right
    path = write_image("a.jpg", stored)
    data = path.read_bytes()
    # An EXIF segment that asks for a turn by 90 degrees: one entry, tag 0x112, orientation 6.
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHII", 8, 1, 0x112, 3, 1, 6) + b"\0" * 4
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    assert cv2.imread(str(path)).shape == (32, 16, 3)  # the segment works: by default OpenCV turns the image
    image = read_image(path)
    assert image.shape == (16, 32, 3)
    apart = np.r_[:14, 18:32]  # the chroma is subsampled, so the colours mix where they meet
    np.testing.assert_allclose(image[:, apart], stored[:, apart] / 255, atol=0.05)  # JPEG's loss


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "deflate.tif", "lzw.tif"])
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
    if name in ("a.png", "deflate.tif"):  # others have no checksums
        contents.append(data[: len(data) // 2] + bytes(30) + data[len(data) // 2 + 30 :])
    for content in contents:
        path.write_bytes(content)
        message = r"is (truncated|damaged (and cannot be read|\(a checksum is wrong\)))\. Copy or export it again\."
        with pytest.raises(InputError, match=message) as caught:
            read_image(path)
        assert caught.value.path == path
    assert capfd.readouterr() == ("", "")


def test_the_c_library_is_silent_and_gamma_is_not_applied(write_image, capfd):
    path = write_image("a.png", RGB16)
    data = path.read_bytes()
    data = with_chunk(data, b"iCCP", b"x\0\0" + zlib.compress(b"no profile"))
    path.write_bytes(with_chunk(data, b"gAMA", struct.pack(">I", 45455)))
    np.testing.assert_array_equal(read_image(path), RGB16 / np.float32(65535))
    assert capfd.readouterr() == ("", "")
    cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert "iCCP" in capfd.readouterr().err  # libpng does complain of this file when nobody holds its mouth


NOT_FINITE = "a value that is not finite"


@pytest.mark.parametrize(
    ("value", "found"), [(np.nan, NOT_FINITE), (np.inf, NOT_FINITE), (-0.5, "the negative value -0.5")]
)
def test_values_no_photograph_has(tmp_path: Path, value: float, found: str) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.array([[1, value]], np.float32))
    with pytest.raises(InputError, match=rf"a\.tif: found {found}.*expected a photograph\.") as caught:
        read_image(path)
    assert ("Set values below zero" in str(caught.value)) == (value == -0.5)


def test_files_that_are_no_such_image(tmp_path: Path) -> None:
    (tmp_path / "empty.tif").touch()
    (tmp_path / "header.tif").write_bytes(b"II*\0\x08\0\0\0")
    tifffile.imwrite(tmp_path / "int.tif", RGB16.astype(np.int32), photometric="rgb")
    palette = np.zeros((3, 256), np.uint16)
    tifffile.imwrite(tmp_path / "palette.tif", RGB8[..., 0], photometric="palette", colormap=palette)
    for name, message in (
        (".", "found a folder, expected an image"),
        ("empty.tif", "the file is empty"),
        ("header.tif", "the TIFF is damaged and cannot be read"),
        ("int.tif", "found int32 pixels, expected 8-bit, 16-bit or floating-point ones"),
        ("palette.tif", "colour model PALETTE, expected gray or RGB"),
    ):
        with pytest.raises(InputError, match=message):
            read_image(tmp_path / name)


def test_mask(write_image: WriteImage) -> None:
    for stored, expected in (
        (np.array([[0, 1], [1, 0]], np.uint8), [[False, True], [True, False]]),
        (np.array([[0, 255], [127, 128]], np.uint8), [[False, True], [False, True]]),
        (np.array([[0, 65535]], np.uint16), [[False, True]]),
        (np.array([[[0, 0, 200], [90, 90, 90]]], np.uint8), [[True, False]]),
    ):
        mask = read_mask(write_image("mask.png", stored))
        assert mask.dtype == np.bool_
        np.testing.assert_array_equal(mask, expected)


CUT_OUT = np.array([[0, 0, 255], [0, 200, 255]], np.uint8)


@pytest.mark.parametrize("name", ["mask.png", "mask.tif"])
@pytest.mark.parametrize("colour", [0, 90, 255])
def test_a_cut_out_is_a_mask_whatever_its_colours(tmp_path: Path, name: str, colour: int) -> None:
    for alpha, scale in ((CUT_OUT, 1), (CUT_OUT.astype(np.uint16) * 257, 257)):
        cv2.imwrite(str(tmp_path / name), np.dstack([np.full_like(alpha, colour * scale)] * 3 + [alpha]))
        np.testing.assert_array_equal(read_mask(tmp_path / name), CUT_OUT > 127)
    # Alpha that cuts nothing out leaves the mask to the colours.
    for nothing in (np.full((2, 3), 255), np.zeros((2, 3)), [[255, 254, 255], [250, 255, 255]]):
        cv2.imwrite(str(tmp_path / name), np.dstack([CUT_OUT] * 3 + [np.asarray(nothing, np.uint8)]))
        np.testing.assert_array_equal(read_mask(tmp_path / name), CUT_OUT > 127)
