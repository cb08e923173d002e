"""Weights of the network that finds objects in pictures, with a card."""
