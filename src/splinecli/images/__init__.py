"""Estimate information that the image values lack: white level, saturated values, mask, and lamp
intensities and colours.
"""
