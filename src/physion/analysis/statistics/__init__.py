"""Statistics of arrays: agreement, correlation, kappa, bootstrap, paired tests."""
