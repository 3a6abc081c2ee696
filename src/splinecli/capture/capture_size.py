"""The common size of a capture's images, and the memory that the capture takes, before any image is decoded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splinecli.capture.formats.facts import ImageFacts, StoredSize
from splinecli.capture.formats.image_size import ExpectedSize, check_memory, check_stored_size, image_bytes

_BYTES_OF_RESULTS = 52
"""Of each pixel of the mask: normals and errors (20), their maps (16), and arrays that are needed for a while."""

_BYTES_OF_ALBEDO = 52
"""Of each pixel of the mask: the colours of two images, sums and the map; one for each light comes on top."""

BYTES_OF_SURFACE = 600
"""Of each pixel of the mask: integration, or the mesh and its files, whichever takes more."""

_IMAGES = 2
"""Images in memory while they are read; see read_ahead."""


def common_size(images: Sequence[ImageFacts]) -> StoredSize:
    """Return the size of the largest of some images.

    Raises:
        InputError: an image has another height or width than the first, is too large, or has no whole header.
    """
    first = images[0]
    check_stored_size(*first.size, first.path)
    expected = ExpectedSize(first.size[0], first.path.name)
    # Opening a RAW file takes long. Its size is compared when it is decoded.
    asked = [first, *(image for image in images[1:] if image.kind != "RAW")]
    for image in asked[1:]:
        expected.check(image.size[0], image.path)
    return max((image.size for image in asked), key=lambda size: image_bytes(*size))


def results_bytes(n_pixels: int, n_lights: int, *, albedo: bool = False, surface: bool = False) -> int:
    """Return the bytes that `infer` takes for the results of a capture, beside its observations."""
    # The surface is made after what the albedo needs is free again.
    more = max(_BYTES_OF_ALBEDO + n_lights if albedo else 0, BYTES_OF_SURFACE if surface else 0)
    return n_pixels * (_BYTES_OF_RESULTS + more)


def capture_bytes(largest: StoredSize, n_pixels: int, n_lights: int) -> int:
    """Return the bytes that `infer` takes for a capture: observations in float32, and images or results.

    Args:
        largest: the size of the largest image.
        n_pixels: the number of the mask's pixels.
        n_lights: the number of images that are read.
    """
    images = min(_IMAGES, n_lights) * image_bytes(*largest)
    return n_pixels * 4 * n_lights + max(images, results_bytes(n_pixels, n_lights))


def check_capture(largest: StoredSize, n_pixels: int, n_lights: int, folder: Path) -> None:
    """Raise InputError where a capture takes more memory than there is; see capture_bytes."""
    height, width = largest[0][:2]
    check_memory(
        capture_bytes(largest, n_pixels, n_lights),
        f"{n_lights} images of {width} x {height} pixels, {n_pixels} of them in the mask, take",
        folder,
        hint="Mask the object, reduce the images (infer --scale), or choose fewer lights",
    )
