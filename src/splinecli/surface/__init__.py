"""Surfaces from normals: heights by integration, triangle meshes and their files. Arrays in, arrays out."""
