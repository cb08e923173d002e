"""The published results of the original study, recomputed."""
