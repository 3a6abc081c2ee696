"""Estimation, refinement and calibration of lights, and the light that reaches each pixel: near
lamps and interreflection.
"""
