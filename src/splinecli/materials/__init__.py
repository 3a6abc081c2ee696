"""Estimate the base colour, roughness, metalness and specular reflection of each pixel from images,
lights and normals.
"""
