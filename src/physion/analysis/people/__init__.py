"""Answers of single participants."""
