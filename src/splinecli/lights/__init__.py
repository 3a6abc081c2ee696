"""Estimation, refinement and calibration of lights, and the light that reaches each pixel from near
lamps and by interreflection.
"""
