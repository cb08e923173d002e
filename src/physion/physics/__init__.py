"""Simulation: a scene becomes a trajectory, a trajectory labels."""
