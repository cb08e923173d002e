"""Datasets in the formats of others: cards, shards and tables."""
