"""The facts in the header of an image file, read in one pass: size, transfer curve, white level and
EXIF tags.

The parts before the pixels are parsed here, with limits, because Pillow may read malicious ones
indefinitely. EXIF tags are read by Pillow, and TIFF tags by tifffile.
"""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from splinecli.capture.formats import decoders, mat
from splinecli.errors import InputError
from splinecli.maths.transfer import BT709, LARGEST_PROFILE, SRGB, TransferCurve, profile_curve
from splinecli.system.files import check_file, reading
from splinecli.system.machine import import_extra

if TYPE_CHECKING:
    from PIL import Image


PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_STARTS = {
    PNG: "PNG",
    JPEG: "JPEG",
    **dict.fromkeys(TIFF, "TIFF"),
    b"BM": "BMP",
    b"P5": "PGM",
    b"P6": "PPM",
}
_BRANDS = {
    b"WEBP": "WEBP",
    b"avif": "AVIF",
    b"avis": "AVIF",
    b"heic": "HEIF",
    b"heix": "HEIF",
    b"mif1": "HEIF",
}
"""The first bytes of files or, after a length and RIFF or ftyp, the bytes from the ninth on."""

PILLOW_KINDS = ("BMP", "TGA", "WEBP", "AVIF", "HEIF")  # 8-bit formats that Pillow decodes
# The groups are the width, the height and the largest value
_PNM = re.compile(rb"P[56]" + 3 * rb"(?:\s|#[^\n]*\n)+?(\d{1,9})" + rb"\s")
# The shape (H, W, C) of an image as stored, and the bytes per value
StoredSize = tuple[tuple[int, ...], int]

ORIENTATION, _EXIF = 0x0112, 0x8769
# EXIF tags of exposure time, f-number and ISO sensitivity, and the ranges of real cameras
_EXPOSURE = {0x829A: (1e-6, 1e5), 0x829D: (0.1, 1e3), 0x8827: (1.0, 1e7)}
# Includes the tags of the focal length; see balls.py
_KEPT = (*_EXPOSURE, 0x920A, 0xA002, 0xA20E, 0xA210, 0xA402, 0xA403, 0xA405)
# Most chunks before the pixels of a PNG, or segments before the frame of a JPEG. Dozens are usual
_MOST_PARTS = 10_000


_FORMATS = "PNG, TIFF, JPEG, BMP, PGM, PPM, WebP, AVIF"


class UnknownFormatError(InputError):
    """A file is not an image of a known format."""


@dataclass(frozen=True)
class StatedCurve:
    """The transfer curve that a file states."""

    curve: TransferCurve = 1.0  # linear if the file states none; see TransferCurve
    by: str = ""  # where it is stated, for messages; empty if it is not stated
    unread: bool = False  # whether the curve of a colour profile cannot be read


_ENCODED = StatedCurve(SRGB, "PNG with sRGB or gAMA")
_CODE_POINTS = dict.fromkeys((1, 6, 14, 15), StatedCurve(BT709, "PNG of a video")) | {
    8: StatedCurve(),
    13: _ENCODED,
}
"""Transfer curves by their numbers in the cICP chunk of a PNG (ITU-T H.273), which takes precedence
over all other chunks.
"""


@dataclass(frozen=True)
class ImageHeader:
    """The facts in the header of an image file."""

    path: Path
    kind: str = ""  # "PNG", "JPEG", "TIFF", "BMP", "TGA", "RAW" or "MAT"; empty if unknown
    stated_size: StoredSize | None = None  # None for a RAW file, and for a damaged one
    # from cICP or a colour profile; otherwise sRGB for JPEG, and for PNG with sRGB or gAMA
    curve: StatedCurve = StatedCurve()
    # white level of a 16-bit image, 2^bits - 1 if the file states the number of bits; None if
    # unknown. It is in the unit of the decoded values, so it is full scale for a RAW file
    # regardless of its tags
    white_level: int | None = None
    # orientation, exposure and focal length by tag number; None for a RAW file that only LibRaw can
    # read
    exif: Mapping[int, Any] | None = field(default_factory=dict)
    # why the file cannot be read; raised when the size is requested
    damage: InputError | None = None

    @property
    def stated_channels(self) -> int | None:
        """The number of channels, including alpha, or None if the header does not state it."""
        return None if self.stated_size is None else (*self.stated_size[0], 1)[2]

    @cached_property
    def size(self) -> StoredSize:
        """The size as stored. Raises InputError for a damaged file. Opening a RAW file is slow."""
        if self.damage is not None:
            raise self.damage
        if self.kind == "RAW":
            return decoders.raw_size(self.path)
        if self.stated_size is None:
            raise InputError(f"the {self.kind} is truncated", self.path, hint=decoders.COPY_AGAIN)
        return self.stated_size


def read_header(path: Path) -> ImageHeader:
    """Return the facts of an image file. It is opened once, and no pixels are decoded."""
    try:
        with open_image(path) as (file, kind):
            return facts_in(file, kind, path)
    except InputError as error:
        return ImageHeader(path, damage=error)


@contextmanager
def open_image(path: Path) -> Iterator[tuple[BinaryIO, str]]:
    """Yield an opened image file and its kind, recognised by content or, for RAW, by name. Raises
    InputError.
    """
    stored, _ = decoders.page_of(path)
    check_file(stored, "an image")
    with reading(path), stored.open("rb") as file:
        start, suffix = file.read(12), path.suffix.lower()
        file.seek(0)
        if not start:
            raise InputError("the file is empty", path)
        otherwise = "TGA" if suffix == ".tga" else None  # TGA files have no signature
        found = next((kind for mark, kind in _STARTS.items() if start.startswith(mark)), otherwise)
        if start[:4] == b"RIFF" or start[4:8] == b"ftyp":
            found = _BRANDS.get(start[8:], found)
        kind = "RAW" if suffix in decoders.RAW_SUFFIXES else found
        if stored != path and stored.suffix.lower() == ".mat":
            kind = "MAT"
        if kind is None:
            raise UnknownFormatError(f"found neither {_FORMATS} nor HEIC", path)
        yield file, kind


def facts_in(file: BinaryIO, kind: str, path: Path) -> ImageHeader:
    """Return the facts of an open image file. Raises InputError for a damaged TIFF."""
    if kind == "RAW":
        exif = _exif_tags(lambda tags: tags.load_from_fp(file))
        # This is the white level of developed RAW files; see decode_raw.
        return ImageHeader(path, kind, white_level=65_535, exif=exif)
    if kind == "MAT":
        return ImageHeader(path, kind, mat.picture_size(path))
    if kind in PILLOW_KINDS:
        with open_with_pillow(file, kind, path) as picture:
            channels = {"1": 1, "L": 1, "LA": 2, "RGBA": 4}.get(picture.mode, 3)
            size = (picture.height, picture.width, channels), 1
            if kind in ("BMP", "TGA"):  # they state nothing else
                return ImageHeader(path, kind, size)
            curve = _curve(StatedCurve(SRGB, kind), picture.info.get("icc_profile"))
            exif = _exif_tags(lambda tags: tags.load(picture.info.get("exif") or b""))
            return ImageHeader(path, kind, size, curve, exif=exif)
    if kind in ("PGM", "PPM"):
        width, height, most, _ = pnm_header(file.read(4096)) or (0, 0, 0, 0)
        shape = (height, width, 1 if kind == "PGM" else 3)
        level = most if 255 < most < 65_535 else None
        return ImageHeader(
            path, kind, (shape, 1 if most < 256 else 2) if most else None, white_level=level
        )
    return {"PNG": _png_facts, "JPEG": _jpeg_facts, "TIFF": _tiff_facts}[kind](file, path)


def pnm_header(start: bytes) -> tuple[int, int, int, int] | None:
    """Return the width, height, largest value and offset of the pixels of a PGM or PPM, or None if
    it is damaged.
    """
    found = _PNM.match(start[:4096])
    return None if found is None else (int(found[1]), int(found[2]), int(found[3]), found.end())


@contextmanager
def open_with_pillow(file: BinaryIO, kind: str, path: Path) -> Iterator[Image.Image]:
    """Yield a picture of PILLOW_KINDS without reading its pixels. Raises InputError."""
    from PIL import Image

    if kind == "HEIF":
        otherwise = "export the photographs as 16-bit TIFF or PNG"
        import_extra(
            "pillow_heif", "heif", error=InputError, path=path, otherwise=otherwise
        ).register_heif_opener()
    with decoders.damage_as_input_error(path, decoders.DAMAGED), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about large pictures, which are checked later
        yield Image.open(file, formats=[kind])


def _png_facts(file: BinaryIO, path: Path) -> ImageHeader:
    file.seek(len(PNG))
    chunks: dict[bytes, bytes] = {}
    for _ in range(_MOST_PARTS):
        if len(start := file.read(8)) < 8 or start[4:] in (b"IDAT", b"IEND"):
            break
        length = int.from_bytes(start[:4], "big")
        content = file.read(min(length, LARGEST_PROFILE if start[4:] in (b"iCCP", b"eXIf") else 16))
        file.seek(length - len(content) + 4, 1)
        chunks.setdefault(start[4:], content)
    header, size = chunks.get(b"IHDR", b""), None
    if next(iter(chunks), None) == b"IHDR" and len(header) >= 10:
        width, height = (int.from_bytes(header[place : place + 4], "big") for place in (0, 4))
        size = (height, width, {0: 1, 4: 2, 6: 4}.get(header[9], 3)), 2 if header[8] == 16 else 1
    profile = None
    if b"iCCP" in chunks:
        try:
            compressed = chunks[b"iCCP"].partition(b"\0")[2]
            profile = zlib.decompressobj().decompress(compressed[1:], LARGEST_PROFILE)
        except zlib.error:
            profile = b""
    # 100000 times the exponent of the encoding; an exponent of 1 means linear.
    gamma = int.from_bytes(chunks.get(b"gAMA", b"")[:4], "big")
    encoded = b"sRGB" in chunks or gamma not in (0, 100_000)
    curve = _curve(_ENCODED if encoded else StatedCurve(), profile)
    if b"cICP" in chunks:
        code = int.from_bytes(chunks[b"cICP"][1:2], "big")
        curve = _CODE_POINTS.get(code, StatedCurve(unread=True))
    # One number per channel. Alpha, if present, comes last.
    stated = chunks.get(b"sBIT", b"")
    bits = set(stated[: 3 if len(stated) > 2 else 1])
    level = _level(bits.pop()) if size is not None and size[1] == 2 and len(bits) == 1 else None
    exif = _exif_tags(lambda tags: tags.load(chunks.get(b"eXIf", b"")))
    return ImageHeader(path, "PNG", size, curve, level, exif)


def _jpeg_facts(file: BinaryIO, path: Path) -> ImageHeader:
    size, exif, parts = None, b"", dict[bytes, bytes]()
    for marker, length in _jpeg_segments(file):
        if _is_frame(marker) and len(frame := file.read(6)) == 6:
            height, width = (int.from_bytes(frame[place : place + 2], "big") for place in (1, 3))
            size = (height, width, frame[5]), 1
        elif marker == 0xE1 and not exif and file.read(6) == b"Exif\0\0":
            exif = file.read(max(length - 6, 0))
        elif marker == 0xE2 and length > 14 and file.read(12) == b"ICC_PROFILE\0":
            number = file.read(2)[:1]
            parts[number] = file.read(length - 14)
    profile = None
    if parts:  # b"" is treated as an unreadable profile
        short = sum(map(len, parts.values())) <= LARGEST_PROFILE
        profile = b"".join(parts[number] for number in sorted(parts)) if short else b""
    curve = _curve(StatedCurve(SRGB, "JPEG"), profile)
    return ImageHeader(path, "JPEG", size, curve, exif=_exif_tags(lambda tags: tags.load(exif)))


def _jpeg_segments(file: BinaryIO) -> Iterator[tuple[int, int]]:
    """Yield the marker and length of each segment up to the frame of a JPEG, with the file
    positioned at its content.
    """
    start, marker = 2, 0
    for _ in range(_MOST_PARTS):
        file.seek(start)
        header = file.read(4)
        if len(header) < 4 or header[0] != 0xFF or _is_frame(marker):
            return
        if header[1] == 0xFF:  # fill
            start += 1
            continue
        marker, length = header[1], int.from_bytes(header[2:], "big")
        yield marker, length - 2
        start += 2 + length


def _is_frame(marker: int) -> bool:
    return 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC)


def _tiff_facts(file: BinaryIO, path: Path) -> ImageHeader:
    with decoders.first_page(file, path) as page:
        bits = int(page.bitspersample)
        size = (page.imagelength, page.imagewidth, page.samplesperpixel), -(-bits // 8)
        tag, profile = page.tags.get(34675), None
        if tag is not None:
            value = tag.value if tag.count <= LARGEST_PROFILE else b""
            profile = value if isinstance(value, bytes) else b""
        # WhiteLevel, MaxSampleValue
        white, largest = (_one_value(page.tags.valueof(code)) for code in (50717, 281))
        has_exif = _EXIF in page.tags or ORIENTATION in page.tags
        place, order, big = page.offset, page.parent.byteorder, page.parent.is_bigtiff

    def load(tags: Image.Exif) -> None:
        tags.endian, tags.bigtiff = order, big
        tags.load_from_fp(file, place)

    level = None
    if bits == 16 and white is not None and 0 < white < 65_535:
        level = white
    elif bits == 16 and largest is not None and largest == _level(largest.bit_length()):
        level = largest  # any other number may be the largest value of this image
    elif bits < 16:
        level = _level(bits)
    exif = _exif_tags(load) if has_exif else {}  # Pillow reads all tags, however long
    return ImageHeader(path, "TIFF", size, _curve(StatedCurve(), profile), level, exif)


def _one_value(tag: object) -> int | None:
    """Return the tag's value if it is one whole number, or the same number for each channel."""
    first, *others = tag if isinstance(tag, tuple) and tag else (tag,)
    return first if isinstance(first, int) and all(other == first for other in others) else None


def _level(bits: int) -> int | None:
    return (1 << bits) - 1 if 8 <= bits < 16 else None


def _curve(stated: StatedCurve, profile: bytes | None) -> StatedCurve:
    """Return the curve of a profile, or the curve stated elsewhere if the profile is missing or
    unreadable.
    """
    if profile is None:
        return stated
    found = profile_curve(profile)
    if found is None:
        return StatedCurve(stated.curve, stated.by, unread=True)
    name, curve = found
    return StatedCurve(curve, f'colour profile "{name}"')


def _exif_tags(load: Callable[[Image.Exif], object]) -> dict[int, Any] | None:
    """Return the tags to keep, none if they are damaged; or None for a RAW file in a proprietary
    format.
    """
    from PIL import Image

    tags, found = Image.Exif(), dict[int, Any]()
    with warnings.catch_warnings():  # Pillow warns about unexpected tags
        warnings.simplefilter("ignore")
        try:
            load(tags)
            if ORIENTATION in tags:
                found[ORIENTATION] = tags[ORIENTATION]
            inside = tags.get_ifd(_EXIF)
            found |= {tag: inside[tag] for tag in _KEPT if tag in inside}
        except SyntaxError:
            return None
        except Exception:  # damaged tags raise a dozen types of errors; decoding reports the damage
            pass
    return found


UPRIGHT = 1  # orientation of images that viewers do not rotate


class Exposure(NamedTuple):
    """Exposure time in seconds, f-number and ISO sensitivity, the last two None if not stated."""

    seconds: float
    f_number: float | None
    iso: float | None

    @property
    def relative(self) -> float:
        """A number proportional to the brightness of the image."""
        return self.seconds * (self.iso or 1) / (self.f_number or 1) ** 2

    def __str__(self) -> str:
        time = f"1/{1 / self.seconds:.0f}" if self.seconds < 0.3 else f"{self.seconds:g}"
        aperture = f", f/{self.f_number:g}" if self.f_number else ""
        return f"{time} s{aperture}" + (f", ISO {self.iso:.0f}" if self.iso else "")


def find_exposure(facts: ImageHeader) -> Exposure | None:
    """Return the exposure of an image, or None if the file is damaged or states no exposure time.

    Values outside the range of real cameras are treated as missing. For example, the f-number of a
    manual lens is missing or zero.
    """
    try:
        if facts.exif is None and facts.kind == "RAW":
            numbers: tuple[Any, ...] = decoders.read_shot(facts.path)
        else:
            numbers = tuple((facts.exif or {}).get(tag, 0) for tag in _EXPOSURE)
        # Some cameras state two ISO numbers.
        values = [float(n[0] if isinstance(n, tuple) else n) for n in numbers]
    except Exception:  # damaged tags cause a dozen types of errors
        return None
    ranges = zip(values, _EXPOSURE.values(), strict=True)
    seconds, *others = (
        value if least <= value <= most else None for value, (least, most) in ranges
    )
    return None if seconds is None else Exposure(seconds, *others)


def _comparable(images: Sequence[ImageHeader]) -> list[tuple[ImageHeader, Exposure]]:
    """Return the images that state the same parts of their exposure as the first that does."""
    found = [
        (facts, exposure) for facts in images if (exposure := find_exposure(facts)) is not None
    ]

    def stated(exposure: Exposure) -> list[bool]:
        return [value is None for value in exposure]

    return [pair for pair in found if stated(pair[1]) == stated(found[0][1])]


def check_exposures(images: Sequence[ImageHeader]) -> None:
    """Raise InputError if two images state different exposures."""
    found = _comparable(images)
    for facts, exposure in found[1:]:
        first, expected = found[0]
        # Stated shutter speeds and ISO numbers are rounded.
        if abs(exposure.relative / expected.relative - 1) > 0.1:
            raise InputError(
                f"found an exposure of {exposure}, expected {expected} as in {first.path.name}",
                facts.path,
                hint="Use the same exposure for all images, or pass each image's exposure as the"
                " intensity of its light (--intensities FILE)",
            )


def exposure_factors(images: Sequence[ImageHeader]) -> tuple[list[float], str] | None:
    """Return each image's exposure relative to their mean, and a sentence about them, or None if
    they are equal.

    Raises InputError, as check_exposures does, if the exposures differ and an image does not state
    its exposure.
    """
    try:
        check_exposures(images)
        return None
    except InputError:
        found = [exposure for _, exposure in _comparable(images)]
        if len(found) < len(images):
            raise
    mean = sum(exposure.relative for exposure in found) / len(found)
    darkest, brightest = (
        choose(found, key=lambda exposure: exposure.relative) for choose in (min, max)
    )
    text = (
        f"The images were divided by their exposures from EXIF, which range from {darkest} to"
        f" {brightest}."
    )
    tags = {"exposure": 0xA402, "white balance": 0xA403}  # 0 is automatic
    stated = [facts.exif or {} for facts in images]
    automatic = [word for word, tag in tags.items() if any(each.get(tag) == 0 for each in stated)]
    if automatic:
        chosen = " and ".join(automatic)
        text += (
            f" The camera chose the {chosen} automatically; use the same fixed settings for all"
            " images."
        )
    return [exposure.relative / mean for exposure in found], text


def common_orientation(images: Sequence[ImageHeader]) -> int:
    """Return the EXIF orientation of all images, 1 to 8, or UPRIGHT if they do not state one.

    The orientation of RAW files is ignored, because their pixels are read in the sensor's
    orientation. Raises InputError if the orientations of two images differ, because their pixels do
    not correspond.
    """
    asked = [facts for facts in images if facts.kind != "RAW"]
    stated = ((facts.exif or {}).get(ORIENTATION, UPRIGHT) for facts in asked)
    orientations = [int(value) if value in range(1, 9) else UPRIGHT for value in stated]
    for facts, orientation in zip(asked, orientations, strict=True):
        if orientation != orientations[0]:
            raise InputError(
                f"found EXIF orientation {orientation}, expected {orientations[0]} as in"
                f" {asked[0].path.name}",
                facts.path,
                hint="Export all images in the same orientation, without this tag",
            )
    return orientations[0] if orientations else UPRIGHT
