"""What models saw and imagined of trials, for the viewer."""
