"""RPIN: states of the regions of objects, and a network that predicts their boxes."""
