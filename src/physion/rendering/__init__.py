"""Frames of a trial: colour, depth, normals, ids, optical flow."""
