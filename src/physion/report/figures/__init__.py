"""Figures of a report: one module each, in the folder of its section; see `registry`."""
