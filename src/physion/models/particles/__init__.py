"""Particle models: GNS, GNS-RANSAC and DPI-Net, which learn how particles of objects move."""
