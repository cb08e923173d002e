"""Rendering of trials: colour, depth, normals, object ids and optical flow of each frame."""
