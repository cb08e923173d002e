"""Figures of a report: one function each, listed in `registry`."""
