"""Readers, which predict P(contact) from features or rollouts of a model."""

from physion.readout.readers.reader import FeatureReader, Reading, RolloutReader, readers

__all__ = ["FeatureReader", "Reading", "RolloutReader", "readers"]
