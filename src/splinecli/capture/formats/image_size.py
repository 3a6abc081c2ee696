"""The one check, and the one message, for the sizes of images and the memory of captures: before they are decoded,
from what their header says.

A few kilobytes may claim gigabytes of pixels, by mistake or by intent.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splinecli.capture.formats.facts import ImageFacts, StoredSize
from splinecli.errors import InputError
from splinecli.system.machine import LARGEST_IMAGE, available_memory


@dataclass(frozen=True)
class ExpectedSize:
    """The size that an image must have."""

    shape: tuple[int, ...]  # (H, W) or (H, W, C)
    like: str  # whose size it is, for messages, such as the name of the first image
    what: str = "an image"  # what the image is, with its article

    def check(self, found: tuple[int, ...], path: Path) -> None:
        """Raise InputError where an image (H, W) or (H, W, C) at `path` has another height or width."""
        if found[:2] != self.shape[:2]:
            raise InputError(
                f"found {self.what} of {_size(found)} pixels, expected {_size(self.shape)} as in {self.like}", path=path
            )


def check_stored_size(
    shape: tuple[int, ...], item_bytes: int, path: Path, expected: ExpectedSize | None = None
) -> None:
    """Raise InputError where an image (H, W) or (H, W, C) is not of the expected size, or too large to be read."""
    if expected is not None:
        expected.check(shape, path)
    n_pixels, n_bytes = math.prod(shape[:2]), image_bytes(shape, item_bytes)
    takes = f"found an image of {_size(shape)} pixels, which takes"
    if n_pixels > LARGEST_IMAGE:
        problem = f"{takes} {_gigabytes(n_bytes)} of memory; expected at most {LARGEST_IMAGE / 1e6:g} megapixels"
        raise InputError(problem, path=path, hint="If the size is right, use a smaller copy of the image")
    check_memory(n_bytes, takes, path)


def check_vectors(shape: tuple[int, ...], path: Path) -> None:
    """Raise InputError where an array is not H x W x 3."""
    if len(shape) != 3 or shape[2] != 3:
        sizes = " x ".join(map(str, shape))
        raise InputError(f"found an array of {sizes}, expected a normal map, H x W x 3", path=path)


def image_bytes(shape: tuple[int, ...], item_bytes: int) -> int:
    """Return the bytes that an image takes in memory, as stored and in float32."""
    return math.prod(shape) * (item_bytes + 4)


def check_memory(n_bytes: int, takes: str, path: Path, *, hint: str | None = None) -> None:
    """Raise InputError where less memory is available; `takes` is the message's subject and verb."""
    available = available_memory()
    if n_bytes > available:
        problem = f"{takes} {_gigabytes(n_bytes)} of memory, but {_gigabytes(available)} are available"
        raise InputError(problem, path=path, hint=hint)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"


def _gigabytes(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.1f} GB"


def common_size(images: Sequence[ImageFacts]) -> StoredSize:
    """Return the size of the largest of some images.

    Raises InputError where one has another height or width than the first, is too large, or has no whole header.
    """
    first = images[0]
    check_stored_size(*first.size, first.path)
    expected = ExpectedSize(first.size[0], first.path.name)
    # Opening a RAW file takes long. Its size is compared when it is decoded.
    asked = [first, *(image for image in images[1:] if image.kind != "RAW")]
    for image in asked[1:]:
        expected.check(image.size[0], image.path)
    return max((image.size for image in asked), key=lambda size: image_bytes(*size))
