"""Datasets in the formats of others: cards, scenes and tables."""
