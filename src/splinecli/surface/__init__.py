"""Surfaces from normals: integration to heights, triangle meshes, and their files."""
