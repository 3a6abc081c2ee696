"""The one check, and the one message, for images of different sizes."""

from __future__ import annotations

from pathlib import Path

from splinecli.errors import InputError


def check_size(
    found: tuple[int, ...], expected: tuple[int, ...], path: Path, *, like: str, what: str = "an image"
) -> None:
    """Raise InputError where two pictures differ in height or width.

    Args:
        found: shape of the picture at `path`, (H, W) or (H, W, C).
        expected: shape that it should have, (H, W) or (H, W, C).
        like: where the expected size comes from, such as the name of the first image.
        what: what the picture is, with its article.
    """
    if found[:2] != expected[:2]:
        raise InputError(
            f"found {what} of {_size(found)} pixels, expected {_size(expected)} as in {like}", path=path
        )


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
