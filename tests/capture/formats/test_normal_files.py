"""Ground truth in every format against the normals that were written."""

import struct
import zlib

import numpy as np
import pytest
import scipy.io
import tifffile
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from scenes import assert_unit, parametrize, put, refuses
from splinecli.capture import read_normal_map
from splinecli.capture.formats.normal_files import read_ground_truth, read_mat
from splinecli.maths.normals import angle_between_deg, encode_picture, unit

SHAPE = (4, 5)
MASK = np.ones(SHAPE, bool)
MASK[0] = False


@pytest.fixture
def normals():
    """(4, 5, 3) unit normals, zero at [1, 2] and outside the mask."""
    field = (
        unit(default_rng(3).normal(size=(*SHAPE, 3)) * [1, 1, 0.2] + [0, 0, 1]) * MASK[..., None]
    )
    field[1, 2] = 0
    return np.asarray(field)


def read_normals(path, mask):
    return read_ground_truth(path, mask)[0]


def write(path, normals):
    match path.suffix:
        case ".mat":
            scipy.io.savemat(path, {"Normal_gt": normals})
        case ".npy":
            np.save(path, normals)
        case ".txt":
            np.savetxt(path, normals.reshape(-1, 3), fmt="%.9f")
        case ".tif":
            tifffile.imwrite(path, np.float32(normals), photometric="rgb")
    return path


@parametrize("name", "a.mat a.npy a.txt a.tif")
@parametrize("length", [1, 0.95, 40])
def test_floating_point_sources(tmp_path, normals, name, length):
    read = read_normals(write(tmp_path / name, normals * length), MASK)
    assert read.dtype == np.float32
    assert_allclose(read, normals, atol=2e-7)


@parametrize("name", "a.png a.tif a.npy a.mat")
# half a step of each channel
@parametrize("bits, error_deg", [(16, 0.002), (8, 0.5)])
def test_pictures(write_image, tmp_path, normals, name, bits, error_deg):
    has_normal = normals.any(axis=2)
    picture = encode_picture(normals, has_normal, bits=bits)
    path = (
        write_image(name, picture)
        if name in ("a.png", "a.tif")
        else write(tmp_path / name, picture)
    )
    read = read_normals(path, MASK)
    assert not read[~has_normal].any()
    assert angle_between_deg(read[has_normal], normals[has_normal]).max() < error_deg
    assert_unit(read[has_normal], 1e-6)


def test_what_is_gray_or_not_finite_or_outside_the_mask_is_no_ground_truth(
    tmp_path, write_image, normals
):
    # zero vectors become 128, 128, 128
    picture = encode_picture(normals, np.ones(SHAPE, bool), bits=8)
    assert not read_normals(write_image("a.png", picture), np.ones(SHAPE, bool))[1, 2].any()
    stored = normals.copy()
    stored[0] = [0, 0, 1]
    stored[2, 3] = [np.nan, 0, 1]
    stored[3, 3] = [0, np.inf, 1]
    read = read_normals(write(tmp_path / "a.npy", stored), MASK)
    assert not read[0].any()
    assert not read[[1, 2, 3], [2, 3, 3]].any()
    assert np.count_nonzero(read.any(axis=2)) == 12


def test_mat_with_another_key(tmp_path, normals):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"N": normals, "mask": MASK})
    assert_allclose(read_normals(path, MASK), normals, atol=1e-6)
    for arrays, names in (({"N": normals, "M": normals}, "N, M"), ({"mask": MASK}, "none")):
        scipy.io.savemat(path, arrays)
        with refuses(f"expected an array Normal_gt or .* found {names}"):
            read_normals(path, MASK)


def test_text_with_commas_and_with_a_wrong_word(tmp_path, normals):
    path = tmp_path / "a.txt"
    rows = ["{:.9f}, {:.9f}, {:.9f}".format(*row) for row in normals.reshape(-1, 3)]
    put(path, "\n".join(rows))
    assert_allclose(read_normals(path, MASK), normals, atol=1e-6)
    put(path, "\n".join([*rows[:6], "0 up 1", *rows[7:]]))
    with refuses(r'a\.txt:7: found "up", expected a number\.'):
        read_normals(path, MASK)


def test_damaged_and_unknown_files_and_other_sizes(tmp_path, normals):
    sizes = dict.fromkeys(
        ("a.mat", "a.npy", "a.tif"), "found a ground truth of 5 x 3 pixels, expected 5 x 4 as in"
    )
    sizes["a.txt"] = "found 15 rows of 3, expected 20 rows of 3, one for each pixel of 4 x 5"
    for name, message in sizes.items():
        with refuses(message):
            read_normals(write(tmp_path / name, normals[1:]), MASK)
    with refuses("does not exist"):
        read_normals(tmp_path / "none.npy", MASK)
    np.save(tmp_path / "pickled.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with refuses("does not contain an array of numbers"):
        read_normals(tmp_path / "pickled.npy", MASK)
    for name, message in [("a.mat", "MATLAB file is damaged"), ("a.npy", r"\.npy file is damaged")]:
        path = write(tmp_path / name, normals)
        path.write_bytes(path.read_bytes()[:150])
        with refuses(message):
            read_normals(path, MASK)
    (tmp_path / "a.exr").touch()
    with refuses(r'the type "\.exr", expected \.mat, \.npy, \.txt, \.png, \.tif or \.bmp'):
        read_normals(tmp_path / "a.exr", MASK)


def test_rows_in_the_wrong_order_are_turned_over(tmp_path, normals):
    # As in the normal.txt of DiLiGenT's Harvest: the rows alone, the vectors are right.
    path = write(tmp_path / "normal.txt", normals[::-1])
    read, upside_down = read_ground_truth(path, MASK)
    assert upside_down
    assert_allclose(read, normals, atol=2e-7)
    assert not read_ground_truth(write(path, normals), MASK)[1]
    # A mask that is its own mirror image tells nothing.
    full = np.ones(SHAPE, bool)
    assert_allclose(read_normals(write(path, normals[::-1]), full), normals[::-1], atol=2e-7)


def test_a_photograph_is_no_normal_map_and_a_huge_value_overflows_nothing(
    tmp_path, write_image, normals
):
    for bits in (8, 16):
        picture = default_rng(0).integers(0, 2**bits, (40, 50, 3)).astype(f"uint{bits}")
        with refuses(r"only 3\d % of the pixels are unit vectors.*this is not a normal map"):
            read_normal_map(write_image("photograph.png", picture))
    damaged = normals.astype(np.float32)
    damaged[3, 4] = 1e30
    assert_allclose(
        np.linalg.norm(read_normal_map(write(tmp_path / "a.npy", damaged))[3, 4]), 1, atol=1e-6
    )


def test_matlab_s_small_whole_numbers_are_vectors(tmp_path):
    """A double whose values are all whole lies as bytes; its class says that it is no picture."""
    plane = np.broadcast_to(np.array([0, 0, 1], np.uint8), (*SHAPE, 3))
    scipy.io.savemat(tmp_path / "a.mat", {"Normal_gt": plane})
    content = bytearray((tmp_path / "a.mat").read_bytes())
    assert content[144] == 9  # class uint8, behind the header and two tags
    content[144] = 6  # double
    (tmp_path / "a.mat").write_bytes(content)
    assert_array_equal(read_normals(tmp_path / "a.mat", MASK), plane * MASK[..., None])


@parametrize("compressed", [False, True])
@parametrize("dtype", "f8 f4 i1 u1 i2 u2 i4 u4 i8 u8")
def test_matlab_s_numbers_are_those_that_scipy_reads(tmp_path, dtype, compressed, rng):
    values = rng.integers(0, 100, (*SHAPE, 3)).astype(dtype)
    arrays = {
        "a": np.eye(2),
        "words": "text",
        "parts": {"b": 1},
        "z": np.ones(3, complex),
        "N": values,
    }
    scipy.io.savemat(tmp_path / "a.mat", arrays, do_compression=compressed)
    read = read_mat(tmp_path / "a.mat", None)
    assert_array_equal(read, scipy.io.loadmat(tmp_path / "a.mat")["N"])
    assert read.dtype == values.dtype


@parametrize("compressed", [False, True])
def test_matlab_s_byte_orders_and_undefined_types(tmp_path, compressed):
    """Of an undefined type, SciPy's reader ends the process."""
    values = np.arange(60.0).reshape(*SHAPE, 3)
    for order in "<>":
        path = write_mat(tmp_path / "a.mat", values, order, kind=9, compressed=compressed)
        assert_array_equal(read_mat(path, None), values)
        assert_array_equal(scipy.io.loadmat(path)["N"], values)
    for kind in (0, 8, 10, 14, 15, 16, 20, 200, 65_535):
        write_mat(path, values, "<", kind=kind, compressed=compressed)
        with refuses("the MATLAB file is damaged and cannot be read"):
            read_normals(path, MASK)


def write_mat(path, values, order, *, kind, compressed):
    """Write the variable N by the description of the format, its numbers with a type."""

    def element(kind, content):
        return struct.pack(order + "II", kind, len(content)) + content + b"\0" * (-len(content) % 8)

    sizes = struct.pack(order + "3i", *values.shape)
    numbers = values.ravel("F").astype(order + "f8").tobytes()
    parts = (6, struct.pack(order + "II", 6, 0)), (5, sizes), (1, b"N"), (kind, numbers)
    matrix = element(14, b"".join(element(*part) for part in parts))
    if compressed:
        packed = zlib.compress(matrix)
        matrix = struct.pack(order + "II", 15, len(packed)) + packed
    mark = struct.pack(order + "HH", 0x100, 0x4D49)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + mark + matrix)
    return path
