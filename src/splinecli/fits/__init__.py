"""Reflectance models fitted to single pixels, in torch: the compared methods, and what the networks start from.

Each file has a `solve`: observations (P, F), the largest of each pixel 1, and light directions (F, 3) -> normals (P, 3)
of any length. Those that the networks start from also take lights (P, F, 3) that differ from pixel to pixel, and
`valid` (P, F), false for observations that are not there.
"""
