"""Readers, which turn features or rollouts of a model into P(contact)."""

from physion.readout.readers.reader import FeatureReader, Reading, RolloutReader, readers

__all__ = ["FeatureReader", "Reading", "RolloutReader", "readers"]
