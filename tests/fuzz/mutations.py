"""Seeded mutations of files: of bytes, of texts and their numbers, of JSON values, of headers, of
what a path is.
"""

import io
import json
import os
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache

import numpy as np
import tifffile
from PIL import Image
from scipy.io import savemat

ODD_NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "1e999",
    "-0",
    "1e-320",
    "9" * 400,
    "9" * 5000,
    "1_0",
    "0x10",
    "١",
    "--1",
    "",
    "-1",
    "4294967296",
    "2147483648",
    "-2147483649",
    "1e308",
    "1,5",
)
ODD_TEXTS = (
    "",
    "\x00",
    "\x1b[2J",
    "a\nsplinecli: warning: fake",
    "../../etc/passwd",
    "/dev/zero",
    "𝔘\u202e",
    "%s",
    "a" * 5000,
)
ODD_VALUES = (
    None,
    True,
    False,
    [],
    {},
    "",
    -1,
    0,
    1.5,
    10**30,
    10**400,
    float("nan"),
    float("inf"),
    "a\nb",
    [[[]]],
    {"a": 1},
    [1, 2, 3],
    -(2**63),
    2**31,
)
ODD_NAMES = (
    b"a\nsplinecli: warning: fake",
    b"\x1b[2J\x07",
    b"a\xff\xfeb",
    b"-o",
    b"--method",
    b"..a",
    b"...",
    b" ",
    b"a b\t",
    b"=1+1",
    b"a" * 240,
    "\u202eb".encode(),
    "é".encode(),
    "e\u0301".encode(),
    b"[a]*?",
    b"$(touch x)`",
    b"'\"",
    b"%s%n",
    b"$\\frac$",
    b"<b>",
    b"~",
    b"a\\b",
    b"nul",
    b"report.json",
    b"mask",
    b"light_directions",
    b"ambient",
    b".hidden",
    b"1e999",
)
"""Names that a terminal, a shell, a spreadsheet or splinecli itself might take for something else.
"""
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_TEXTS = (".txt", ".lp", ".json", ".toml", ".csv", ".jsonl", ".html")


def flip(data, rng):
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if content:
            content[rng.randrange(len(content))] = rng.randrange(256)
    return bytes(content)


def flip_header(data, rng):
    return flip(data[:128], rng) + data[128:]


def cut(data, rng):
    return data[: rng.randrange(len(data) + 1)]


def splice(data, rng):
    start, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    if rng.random() < 0.5:
        return data[:start] + data[end:]
    return data[:end] + data[start:end] * rng.choice((1, 3, 50)) + data[end:]


def odd_word(data, rng):
    """Write an odd binary number somewhere."""
    form = rng.choice(("<I", ">I", "<H", ">H", "<Q"))
    word = struct.pack(
        form, rng.choice((0, 1, 0x7FFF, 0x8000, 0xFFFF)) * (65_537 if form[1] != "H" else 1)
    )
    place = rng.randrange(max(1, len(data)))
    return data[:place] + word + data[place + len(word) :]


def fill(data, rng):
    start, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:start] + bytes([rng.choice((0, 255, 32))]) * (end - start) + data[end:]


def long(data, rng):
    """Repeat the file, or one of its lines, up to a length of megabytes."""
    rows = data.split(b"\n")
    part = rng.choice((data, rng.choice(rows) + b"\n", b"\n", b" ", b"1 ")) or b"\n"
    length = rng.choice((500_000, 990_000, 1_100_000, 60_000_000))
    return data[: rng.randrange(len(data) + 1)] + part * (length // len(part))


def garbage(data, rng):
    return rng.choice(
        (
            b"",
            b"\0" * 4096,
            rng.randbytes(300),
            b"[" * 100_000,
            b"\xff\xfe" + data,
            "é\n".encode("utf-16"),
        )
    )


def number(data, rng):
    found = list(_NUMBER.finditer(data))
    if not found:
        return flip(data, rng)
    match = rng.choice(found)
    return data[: match.start()] + rng.choice(ODD_NUMBERS).encode() + data[match.end() :]


def lines(data, rng):
    rows = data.split(b"\n")
    place = rng.randrange(len(rows))
    changed = (
        [rng.choice(rows), rows[place]],
        [],
        [rng.choice(ODD_TEXTS).encode("utf-8", "surrogatepass")],
    )
    rows[place : place + 1] = rng.choice(changed)
    if rng.random() < 0.25:
        rng.shuffle(rows)
    return b"\n".join(rows)


def json_value(data, rng):
    """Replace, remove or repeat one value of a JSON document."""
    try:
        document = json.loads(data)
    except ValueError:
        return flip(data, rng)
    places = []

    def collect(value):
        for key in (
            value
            if isinstance(value, dict)
            else range(len(value))
            if isinstance(value, list)
            else ()
        ):
            places.append((value, key))
            collect(value[key])

    collect(document)
    if places and rng.random() < 0.97:
        holder, key = rng.choice(places)
        if rng.random() < 0.2:
            del holder[key]
        else:
            holder[key] = rng.choice(ODD_VALUES)
    else:
        document = rng.choice(ODD_VALUES)
    return json.dumps(document).encode("utf-8", "surrogatepass")


def png_header(data, rng):
    """Change the size or the kind of a PNG, with the right checksum."""
    if not data.startswith(b"\x89PNG") or len(data) < 33:
        return flip_header(data, rng)
    body = bytearray(data[12:29])
    if rng.random() < 0.6:
        struct.pack_into(
            ">I", body, 4 + 4 * rng.randrange(2), rng.choice((0, 1, 17, 30_000, 2**31 - 1))
        )
    else:
        body[rng.randrange(12, 17)] = rng.randrange(20)
    return data[:12] + bytes(body) + struct.pack(">I", zlib.crc32(body)) + data[33:]


@cache
def _bomb(suffix):
    """Return a whole file of many zeros: a picture of 8000 x 8000 pixels, normals of 4000 x 4000,
    or weights.
    """
    if suffix == ".safetensors":  # many empty tensors
        empty = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
        header = json.dumps({f"t{number}": empty for number in range(10_000)}).encode()
        return struct.pack("<Q", len(header)) + header
    if suffix == ".ckpt":
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
            file.writestr("archive/data.pkl", b"\x80\x02}q\x00.")
            file.writestr("archive/data/0", bytes(100_000_000))
        return packed.getvalue()
    rows = zlib.compress(bytes(8000 * 8001), 1)
    if suffix == ".png":
        parts = (
            (b"IHDR", struct.pack(">IIBBBBB", 8000, 8000, 8, 0, 0, 0, 0)),
            (b"IDAT", rows),
            (b"IEND", b""),
        )
        chunks = (kind + content for kind, content in parts)
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
            for chunk in chunks
        )
    buffer = io.BytesIO()
    if suffix == ".mat":
        savemat(buffer, {"Normal_gt": np.zeros((4000, 4000, 3), np.uint8)}, do_compression=True)
    else:
        tifffile.imwrite(buffer, np.zeros((8000, 8000), np.uint8), compression="zlib")
    return buffer.getvalue()


def safetensors_header(data, rng):
    """Change a value in the header of a safetensors file, or in the JSON texts of its metadata."""
    length = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(data[8 : 8 + length])
        metadata = header["__metadata__"]
    except (ValueError, KeyError, TypeError):
        return flip(data, rng)
    if rng.random() < 0.8:
        key = rng.choice(sorted(metadata))
        metadata[key] = json_value(metadata[key].encode(), rng).decode("utf-8", "replace")
        text = json.dumps(header).encode()
    else:
        text = json_value(json.dumps(header).encode(), rng)
    return len(text).to_bytes(8, "little") + text + data[8 + length :]


OF_BYTES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    flip,
    flip,
    flip_header,
    flip_header,
    cut,
    splice,
    odd_word,
    odd_word,
    fill,
    garbage,
)


def mat_type(data, rng):
    """Change the type of an element of a .mat file, in its compressed content if there is one."""
    if data[128:132] == struct.pack("<I", 15):
        length = struct.unpack("<I", data[132:136])[0]
        try:
            inner = _another_type(zlib.decompress(data[136 : 136 + length]), rng)
        except zlib.error:
            return flip(data, rng)
        packed = zlib.compress(inner)
        return data[:128] + struct.pack("<II", 15, len(packed)) + packed + data[136 + length :]
    return data[:128] + _another_type(data[128:], rng)


def _another_type(content, rng):
    place = 8 * rng.randrange(min(10, len(content) // 8) or 1)
    kind = rng.choice((0, 8, 10, 11, 14, 15, 16, 17, 18, 20, 200, 65_535, 0x40001, 0x8000FFFF))
    return content[:place] + struct.pack("<I", kind) + content[place + 4 :]


def npy_header(data, rng):
    """Change the shape or the type in the header of a .npy file."""
    end = 10 + int.from_bytes(data[8:10], "little")
    header = data[10:end].decode("latin-1")
    if rng.random() < 0.5:
        shape = rng.choice(
            (
                "(100000, 100000, 3)",
                "(-1, 3)",
                "()",
                "(0, 0, 3)",
                "(3,)",
                "(2, 2, 3, 1)",
                "(1" + "," * 99 + ")",
            )
        )
        header = re.sub(r"'shape': \([^)]*\)", f"'shape': {shape}", header)
    else:
        kind = rng.choice(
            (
                "|O",
                "<U9",
                "<c16",
                "|b1",
                ">f2",
                "<f16",
                "|V8",
                "<M8[s]",
                "|S99999999",
                "<i8",
                "<u1",
                "x",
            )
        )
        header = re.sub(r"'descr': '[^']*'", f"'descr': '{kind}'", header)
    text = header.encode("latin-1")
    return data[:8] + struct.pack("<H", len(text)) + text + data[end:]


def profile(data, rng):
    """Write an image anew with a damaged colour profile."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            old, buffer = image.info["icc_profile"], io.BytesIO()
            change = rng.choice(
                (flip, flip_header, cut, odd_word, odd_word, fill, _tag, _tag, _tag)
            )
            image.save(buffer, image.format, icc_profile=change(old, rng))
        return buffer.getvalue()
    except Exception:
        return flip_header(data, rng)


def _tag(data, rng):
    """Change a word in the table of a profile, or in one of its curves."""
    entry = 132 + 12 * rng.randrange(int.from_bytes(data[128:132], "big"))
    place = entry + 4 * rng.randrange(3)
    if rng.random() < 0.7:
        place = max(data.find(rng.choice((b"para", b"curv"))), 0) + 4 * rng.randrange(9)
    word = rng.choice(
        (
            b"para",
            b"curv",
            *(struct.pack(">i", n) for n in (0, 1, 3 << 16, 4, -1, -(2**31), 2**31 - 1)),
        )
    )
    return data[:place] + word + data[place + 4 :]


OF_TEXTS = (number, number, number, lines, lines)
OF_FORMATS = {
    ".mat": (mat_type,) * 8,
    ".json": (json_value,) * 15,
    ".png": (png_header,) * 4,
    ".npy": (npy_header,) * 8,
    ".safetensors": (safetensors_header,) * 20,
}


def mutate(path, others, rng):
    """Change a file in one way and return a description."""
    if rng.random() < 0.06:
        return _another_kind(path, others, rng)
    choices = [*OF_BYTES]
    if path.suffix in _TEXTS:
        choices += OF_TEXTS * 2 + (long,)
    if path.suffix in (".png", ".tif", ".mat", ".safetensors", ".ckpt"):
        choices.append(lambda _, __: _bomb(path.suffix))
    choices += OF_FORMATS.get(path.suffix, ())
    if path.parent.name == path.suffix[1:]:  # images with profiles
        choices += [profile] * 25
    change = rng.choice(choices)
    data = path.read_bytes()
    path.unlink()  # it may be a link to the corpus
    path.write_bytes(change(data, rng))
    return f"{change.__name__.strip('<>')} {path.name}"


def rename(path, rng):
    """Give a file or a folder an odd name, most often with its own suffix, and return it."""
    suffix = path.suffix if rng.random() < 0.8 else ""
    new = path.with_name(os.fsdecode(rng.choice(ODD_NAMES)) + suffix)
    if new.exists():
        new = path.with_name(f"{new.stem} 2{suffix}")
    path.rename(new)
    return new


def odd_path(name, rng):
    """Return another way to write the path of a file or folder in the present folder."""
    forms = (
        "{}",
        "{}",
        "./{}",
        ".//{}",
        "../case/{}",
        "{}/../{}",
        "{}/",
        "{}/.",
        "nothing/../{}",
        "-{}",
        "",
    )
    return rng.choice(forms).format(name, name)


def _another_kind(path, others, rng):
    """Put something else in the place of a file: a folder, a pipe, a device, another file, or
    nothing.
    """
    kind = rng.choice(
        ("folder", "pipe", "loop", "device", "other file", "nothing", "huge", "unreadable")
    )
    existing = [file for file in others if file.is_file()]
    other = rng.choice(existing or [path]).read_bytes()
    path.unlink()
    if kind in ("other file", "huge", "unreadable"):
        path.write_bytes(other)
    changes: dict[str, Callable[[], object]] = {
        "folder": path.mkdir,
        "pipe": lambda: os.mkfifo(path),
        "loop": lambda: path.symlink_to(path.name),
        "device": lambda: path.symlink_to("/dev/zero"),
        "huge": lambda: os.truncate(path, 3 << 30),
        "unreadable": lambda: path.chmod(0),
    }
    changes.get(kind, lambda: None)()
    return f"{kind} {path.name}"
