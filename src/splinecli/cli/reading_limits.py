"""Limits on what the commands read. They hold for the whole process, as Pillow's do."""

from __future__ import annotations


def limit_reading(max_pixels_per_image: int, *, images_elsewhere: bool = False) -> None:
    """Set the limits of --max-pixels-per-image and --images-elsewhere."""
    from splinecli.capture.formats.image_size import limit_pixels
    from splinecli.capture.layouts.image_lists import allow_images_elsewhere

    limit_pixels(max_pixels_per_image)
    allow_images_elsewhere(images_elsewhere)
