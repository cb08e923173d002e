"""Figures of the section stimulus by stimulus."""
