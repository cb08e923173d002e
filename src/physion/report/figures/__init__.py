"""Figures of a report: one module for each section of the page; see `theme`."""
