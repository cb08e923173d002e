"""Answers of single participants, and their analysis."""
