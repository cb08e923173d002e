"""Clips, features, and the training of dynamics on them."""
