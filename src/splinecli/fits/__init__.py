"""Reflectance models that are fitted to single pixels, in torch: the compared methods and the networks' starting fits.

The file of a method has a `solve`: observations (P, F) float64, the largest of each pixel 1, and unit light directions
(F, 3), or (P, F, 3) where they differ from pixel to pixel -> normals (P, 3) of any length. The networks' starting fits
also take `valid` (P, F), which is false for missing observations. The other files have what several of them use.
"""
