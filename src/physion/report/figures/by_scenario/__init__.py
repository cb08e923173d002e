"""Figures of the section by scenario."""
