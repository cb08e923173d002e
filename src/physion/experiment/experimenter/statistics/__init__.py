"""Statistics of the experimenter's pages, computed in a separate process."""
