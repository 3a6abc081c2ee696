"""Fixtures of small pixel sets."""

from small_pixel_sets import _matte_pixels, make_set

__all__ = ["_matte_pixels", "make_set"]
