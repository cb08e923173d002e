"""Procedural textures: painting, mip levels, lookup."""
