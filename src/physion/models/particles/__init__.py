"""Particle models: GNS, GNS-RANSAC and DPI-Net, which learn how particles of objects move.

- `simulator`: settings, loss and imagination of the models.
- `networks`: scenes as graphs, and graph networks. `neighbours`: which particles are close.
- `bodies`: objects as particles, and rigid motions. `rollout`: rollouts, windows, distances.
"""
