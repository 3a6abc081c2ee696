"""Reflectance models fitted to single pixels in torch: the methods for comparison, and the fits
that the networks start from.

A method's function, such as `solve_ia14`, returns normals (P, 3) of any length for observations
(P, F) float64, scaled to a largest value of 1 per pixel, and unit light directions (F, 3), or
(P, F, 3) if they differ from pixel to pixel. The networks' starting fits also take `valid` (P, F),
which is false for missing observations. Fits that do not need torch are in maths/robust.py.
"""
