"""Datasets for others: tar shards, dataset card, Croissant metadata."""
