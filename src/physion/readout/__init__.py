"""Readouts: predictions of contact from the features or the simulations of a model."""
