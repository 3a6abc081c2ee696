"""Surfaces from normals: integration into heights, triangle meshes, and their files."""
