"""Weights of what is expected of objects, with a card."""
