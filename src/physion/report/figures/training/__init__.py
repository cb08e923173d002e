"""Figures of the section on readout and training."""
