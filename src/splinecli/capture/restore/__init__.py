"""Restore what the images do not contain: saturated values, light intensities, the mask."""
