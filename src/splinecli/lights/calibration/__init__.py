"""Calibration of lights: directions from images of mirror balls, intensities from images of a gray
target.
"""
