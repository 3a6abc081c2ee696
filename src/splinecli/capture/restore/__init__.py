"""What photographs lack and other observations show: saturated pixels, light intensities, the mask."""
