"""What the values of images do not contain: white level, saturated values, mask, intensities and colours of lamps."""
