"""Reflectance models that are fitted to single pixels, in torch: the compared methods and the networks' starting fits.

Each file has a `solve`: observations (P, F), the largest of each pixel 1, and light directions (F, 3) -> normals (P, 3)
of any length. The networks' starting fits also take lights (P, F, 3) that differ from pixel to pixel, and `valid` (P,
F), which is false for missing observations.
"""
