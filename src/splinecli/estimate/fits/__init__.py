"""Reflectance models that are fitted to single pixels, in torch: the compared methods and the
networks' starting fits.

The function of a method, such as `solve_ia14`, takes observations (P, F) float64, the largest of
each pixel 1, and unit light directions (F, 3), or (P, F, 3) if they differ from pixel to pixel, to
normals (P, 3) of any length. The networks' starting fits also take `valid` (P, F), which is false
for missing observations. `robust.py` has the fits that do not need torch.
"""
