"""Information missing from image values: white level, saturated values, mask, intensities and
colours of lamps.
"""
