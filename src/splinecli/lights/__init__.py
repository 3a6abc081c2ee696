"""Lights that are found or refined, and the light that reaches each pixel: near lamps,
interreflection.
"""
