"""Files that claim or hide far more than they show are refused from their headers, without taking
memory.
"""

import io
import os
import resource
import struct
import sys
import zlib
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from scenes import parametrize, png_chunk, put, refuses, vectors, write_image
from splinecli.capture import open_capture
from splinecli.capture.formats import decoders
from splinecli.capture.formats.facts import read_header
from splinecli.capture.formats.images import ExpectedSize, check_stored_size, decode_image
from splinecli.capture.formats.normal_files import (
    read_depth,
    read_ground_truth,
    read_normal_map,
)
from splinecli.capture.light_files import read_light_directions
from splinecli.lights.calibration.balls import calibrate_ball, find_ball_files
from splinecli.lights.calibration.lamps import measure_light_intensities
from splinecli.pipeline.infer_options import InfoOptions
from splinecli.pipeline.info import describe_capture
from splinecli.recipe import RecipeOptions, prepare_capture

HUGE = 30_000
SMALL = (16, 18)
TOO_LARGE = (
    r"(30|21)000 x (30|21)000 pixels, which takes \d+\.\d GB of memory, expected at most 400 "
    r"megapixels"
)
MOST_GROWTH = 300 * 2**20

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux does")


def write_claim(path, height, width):
    """A PNG that states a size and has no pixels. Whoever decodes it finds it damaged."""
    write_image(path, np.zeros(SMALL, np.uint8))
    content = path.read_bytes()
    header = struct.pack(">II", width, height) + content[24:29]
    path.write_bytes(content[:8] + png_chunk(b"IHDR", header) + png_chunk(b"IEND", b""))


def write_jpeg(path):
    content = bytearray(cv2.imencode(".jpg", np.zeros(SMALL, np.uint8))[1].tobytes())
    frame = content.index(b"\xff\xc0")
    content[frame + 5 : frame + 9] = struct.pack(">HH", HUGE, HUGE)
    path.write_bytes(content)


def write_tiff(path, height, width, data, *, tile=0):
    """A TIFF whose only strip, or tile, is these compressed bytes."""
    layout = (
        [(322, tile), (323, tile), (324, 0), (325, len(data))]
        if tile
        else [(273, 0), (278, height)]
    )
    layout += [] if tile else [(279, len(data))]
    tags = sorted([(256, width), (257, height), (258, 8), (259, 8), (262, 1), (277, 1), *layout])
    start = 8 + 2 + 12 * len(tags) + 4
    values = ((tag, start if tag in (273, 324) else value) for tag, value in tags)
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in values)
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4) + data)


def write_mat(path, shape, n_zeros):
    """A compressed .mat file whose array claims a shape and expands to a number of zeros."""
    buffer = io.BytesIO()
    savemat(buffer, {"Normal_gt": np.zeros((2, 2, 3))})
    plain = buffer.getvalue()
    header, matrix = plain[:128], bytearray(plain[136:])
    place = matrix.index(struct.pack("<III", 2, 2, 3))
    matrix[place : place + 12] = struct.pack("<III", *shape)
    data = matrix.index(struct.pack("<II", 9, 96))
    matrix[data : data + 8] = struct.pack("<II", 9, n_zeros)
    element = struct.pack("<II", 14, data + 8 + n_zeros) + bytes(matrix[: data + 8])
    packer = zlib.compressobj(1)
    packed = packer.compress(element)
    packed += (
        b"".join(packer.compress(bytes(1 << 20)) for _ in range(n_zeros >> 20)) + packer.flush()
    )
    path.write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)


def growth(work):
    """Bytes by which the largest memory of a process grows while it does the work."""
    reader, writer = os.pipe()
    if os.fork() == 0:
        before = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
        work()
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        os.write(writer, str(peak - before).encode())
        os._exit(0)
    os.close(writer)
    os.wait()
    return int(os.read(reader, 100))


def refused(work, match):
    """Check that the work raises InputError, and that this takes little memory."""

    def check():
        with refuses(match):
            work()

    check()
    assert growth(check) < MOST_GROWTH


def ground_truth(path):
    return read_ground_truth(path, np.ones(SMALL, np.bool_))


def test_images_too_large_to_read(tmp_path):
    write_claim(tmp_path / "a.png", 21_000, 21_000)
    write_jpeg(tmp_path / "a.jpg")
    write_tiff(tmp_path / "a.tif", HUGE, HUGE, zlib.compress(bytes(1000)))
    for name in ("a.png", "a.jpg", "a.tif"):
        refused(lambda name=name: decode_image(tmp_path / name), TOO_LARGE + ".*a smaller copy")


def test_images_of_another_size_than_others_are_not_decoded(tmp_path):
    ball, capture = tmp_path / "ball", tmp_path / "capture"
    for folder in (ball, capture):
        folder.mkdir()
        for number in range(4):
            write_image(folder / f"{number}.png", np.full(SMALL, 9 + number, np.uint8))
    put(capture / "lights.txt", "0 0 1\n1 0 1\n0 1 1\n1 1 2")
    write_claim(tmp_path / "large.png", 15_000, 15_000)
    np.save(tmp_path / "normals.npy", np.ones((*SMALL, 3)))
    sizes = "of 15000 x 15000 pixels, expected 18 x 16 as in 0.png"
    with refuses(f"found a mask {sizes}"):
        calibrate_ball(find_ball_files(ball, mask=tmp_path / "large.png"))
    with refuses("a ground truth of 15000 x 15000 pixels, expected 18 x 16 as in the images"):
        ground_truth(tmp_path / "large.png")
    with refuses("a normal map of 18 x 16 pixels, expected 15000 x 15000"):
        read_normal_map(tmp_path / "normals.npy", tmp_path / "large.png")
    write_claim(capture / "1.png", *SMALL)
    write_claim(capture / "3.png", 15_000, 15_000)
    with refuses(f"3.png: found an image {sizes}"):
        prepare_capture(open_capture(capture))


def test_a_capture_larger_than_the_memory_is_not_decoded(tmp_path, monkeypatch):
    """Six images of 361 megapixels: each would fit by itself."""
    put(tmp_path / "lights.txt", "0 0 1\n1 0 1\n0 1 1\n1 1 2\n0 1 2\n1 0 2")
    for number in range(6):
        write_claim(tmp_path / f"{number}.png", 19_000, 19_000)
    monkeypatch.setattr("splinecli.capture.formats.images.available_memory", lambda: 5e9)
    match = r"6 images of 19000 x 19000 pixels.* take 27\.4 GB of memory, but 5\.0 GB are available"
    refused(lambda: prepare_capture(open_capture(tmp_path)), match)
    with refuses("3 images of 19000 x 19000 pixels"):
        prepare_capture(open_capture(tmp_path), [0, 1, 2])


@parametrize("size", [(754_974_744, 24), (2**31 - 1, 2**31 - 1)])
def test_no_command_takes_memory_for_a_header(tmp_path, size):
    lights = vectors("0 0 1; 0.6 0 0.8; 0 0.6 0.8; -0.6 0 0.8")
    np.savetxt(tmp_path / "lights.txt", lights)
    for number in range(4):
        write_claim(tmp_path / f"{number}.png", *size)
    match = (
        rf"0\.png: found an image of {size[1]} x {size[0]} pixels.* expected at most 400 megapixels"
    )
    refused(lambda: describe_capture(InfoOptions(capture=tmp_path)), match)
    options = RecipeOptions(auto_mask=True)
    refused(lambda: prepare_capture(open_capture(tmp_path), options=options), match)
    refused(lambda: open_capture(tmp_path).read_mask(size), match)
    refused(lambda: measure_light_intensities(find_ball_files(tmp_path), lights, "card"), match)
    for number in range(3):
        write_image(tmp_path / f"{number}.png", np.full(SMALL, 99 + number, np.uint8))
    other = (
        rf"3\.png: found an image of {size[1]} x {size[0]} pixels, expected {SMALL[1]} x "
        rf"{SMALL[0]} as in 0\.png"
    )
    refused(lambda: describe_capture(InfoOptions(capture=tmp_path)), other)


def test_content_that_expands_beyond_its_shape(tmp_path):
    write_tiff(tmp_path / "a.tif", *SMALL, zlib.compress(bytes(1 << 28), 1))
    refused(lambda: decode_image(tmp_path / "a.tif"), "the TIFF is damaged")
    write_mat(tmp_path / "a.mat", (*SMALL, 3), 1 << 28)
    refused(lambda: ground_truth(tmp_path / "a.mat"), "the MATLAB file is damaged")
    with (tmp_path / "normal.txt").open("wb") as file:
        file.truncate(1 << 31)
    refused(
        lambda: ground_truth(tmp_path / "normal.txt"), r"expected a text file of at most 1\.0 MB"
    )


def test_a_tiff_whose_tile_is_larger_than_its_picture(tmp_path):
    for name, side in (("small.tif", 128), ("a.tif", 21_000)):
        packer = zlib.compressobj(1)
        tile = b"".join(packer.compress(bytes(side)) for _ in range(side)) + packer.flush()
        write_tiff(tmp_path / name, *SMALL, tile, tile=side)
    assert decode_image(tmp_path / "small.tif").shape == (*SMALL, 1)
    refused(lambda: decode_image(tmp_path / "a.tif"), "the TIFF is damaged")


def test_headers_without_end(tmp_path):
    """Each would take seconds to minutes to walk through. The steps that are read are counted in
    place of time.
    """
    jpeg, png, mat = (tmp_path / name for name in ("a.jpg", "a.png", "a.mat"))
    jpeg.write_bytes(b"\xff\xd8" + b"\xff" * 2_000_000)
    refused(lambda: decode_image(jpeg), "the JPEG is truncated")
    jpeg.write_bytes(b"\xff\xd8" + b"\xff\xe1\0\2" * 2_000_000)
    refused(lambda: decode_image(jpeg), "the JPEG is truncated")
    plain = cv2.imencode(".png", np.zeros(SMALL, np.uint8))[1].tobytes()
    png.write_bytes(plain[:33] + png_chunk(b"tEXt", b"") * 1_000_000 + plain[33:])
    assert read_header(png).white_level is None
    refused(lambda: decode_image(png), "the PNG is truncated")
    png.write_bytes(plain[:33])
    with png.open("ab") as file:
        file.truncate(3 << 30)
    assert read_header(png).curve.curve == 1
    mat.write_bytes(bytes(126) + b"IM")
    with mat.open("ab") as file:
        file.truncate(3 << 30)
    refused(lambda: ground_truth(mat), "the MATLAB file is damaged")


def test_arrays_too_large_to_read(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (HUGE, HUGE, 3)}
        np.lib.format.write_array_header_1_0(file, header)
        # a sparse file, which holds nothing on the disk
        file.truncate(HUGE * HUGE * 24 + file.tell())
    refused(
        lambda: ground_truth(tmp_path / "a.npy"), "found a ground truth of 30000 x 30000 pixels"
    )
    refused(lambda: read_normal_map(tmp_path / "a.npy"), TOO_LARGE)
    write_mat(tmp_path / "a.mat", (HUGE, HUGE, 3), 1 << 20)
    refused(
        lambda: ground_truth(tmp_path / "a.mat"), "found a ground truth of 30000 x 30000 pixels"
    )
    refused(lambda: read_normal_map(tmp_path / "a.mat"), TOO_LARGE)


def test_a_picture_with_gigabytes_behind_it(tmp_path):
    for name in ("a.png", "a.jpg", "a.tif"):
        write_image(tmp_path / name, np.ones(SMALL, np.uint8))
        with (tmp_path / name).open("ab") as file:
            file.truncate(1 << 31)
        refused(
            lambda name=name: decode_image(tmp_path / name),
            r"found 2147\.5 MB, expected at most 67\.1 MB",
        )


def test_the_pages_of_a_long_tiff(tmp_path, monkeypatch):
    """Of each page only its parts are read, and the pages are found once: together they would take
    time in the square of their number.
    """
    pictures = [np.full(SMALL, 9 * number, np.uint16) for number in range(20)]
    tifffile.imwrite(tmp_path / "plain.tif", np.array(pictures), photometric="minisblack")
    cv2.imwritemulti(str(tmp_path / "packed.tif"), pictures)  # LZW, which only OpenCV decodes
    for name in ("plain.tif", "packed.tif"):
        with (tmp_path / name).open("ab") as file:
            file.truncate(1 << 31)
        listed = decoders.pages(tmp_path / name)
        assert len(listed) == 20
        walk = Mock(wraps=decoders._places)
        monkeypatch.setattr(decoders, "_places", walk)
        for page, picture in zip(listed, pictures, strict=True):
            assert np.array_equal(decode_image(page)[..., 0], picture)
        assert walk.call_count < 5  # those of the first page are not searched
        assert growth(lambda listed=listed: [decode_image(page) for page in listed]) < MOST_GROWTH


def test_light_files_with_too_much_text(tmp_path):
    for text, message in (
        ("0 0 1" + " " * 1_000_000, "found 1.0 MB, expected a text file of at most 1.0"),
        ("1\n" * 60_000, "found 60001 lines, expected at most 50000"),
        ("1 " * 400_000, "found 400000 columns, expected 3"),
    ):
        put(tmp_path / "a.txt", text)
        refused(lambda: read_light_directions(tmp_path / "a.txt"), message)


def test_matrices_of_which_none_can_be_the_lights(tmp_path):
    """A hundred that expand to 8 MB each."""
    content, rows = b" " * 124 + b"\0\1IM", 1 << 18
    for number in range(100):
        matrix = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIII", 5, 8, rows, 3)
        matrix += struct.pack("<HH", 1, 3) + b"m%02d\0" % number
        matrix += struct.pack("<II", 2, 3 * rows) + bytes(3 * rows)
        packed = zlib.compress(struct.pack("<II", 14, len(matrix)) + matrix)
        content += struct.pack("<II", 15, len(packed)) + packed
    (tmp_path / "lights.mat").write_bytes(content)
    message = r"found several matrices N x 3 or 3 x N: m00 \(262144 x 3\), .* and 94 more"
    refused(lambda: read_light_directions(tmp_path / "lights.mat", 8), message)


def test_a_depth_with_a_thousand_channels(tmp_path):
    library = pytest.importorskip("OpenEXR")
    depth, header = np.zeros((300, 300), np.float32), {"compression": library.ZIP_COMPRESSION}
    channels = {f"c{number}": depth for number in range(1000)}
    library.File(header, channels).write(str(tmp_path / "a.exr"))
    parts = [
        library.Part({"name": name}, {"Z": depth, name: depth}) for name in map(str, range(150))
    ]
    library.File(parts).write(str(tmp_path / "parts.exr"))
    size = ExpectedSize(depth.shape, "the normal map")
    for name, count in (("a.exr", 1000), ("parts.exr", 300)):
        message = f"found {count} channels, expected at most 256. Save only the depth channel"
        refused(lambda name=name: read_depth(tmp_path / name, size), message)


def test_an_image_larger_than_the_memory(monkeypatch):
    monkeypatch.setattr("splinecli.capture.formats.images.available_memory", lambda: 1e9)
    check_stored_size((10_000, 10_000), 1, Path("a.png"))
    with refuses(r"takes 1\.5 GB of memory, but 1\.0 GB are available"):
        check_stored_size((10_000, 10_000, 3), 1, Path("a.png"))
