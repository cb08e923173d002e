"""Collision detection of convex hulls: closest points, penetration, persistent manifolds."""
