"""Files of trained weights: how they are written and read, and those that ship."""
