"""Fixtures of small pixel sets."""

from small_pixel_sets import make_set

__all__ = ["make_set"]
