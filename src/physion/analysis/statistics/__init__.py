"""Statistics of arrays: agreement, correlation, kappa, calibration, bootstrap, paired tests."""
