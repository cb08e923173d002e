"""Shapes: primitives and props, with the convex pieces that they collide by."""
