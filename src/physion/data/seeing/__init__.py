"""Readouts that ship, with a card for each."""
