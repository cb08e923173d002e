"""Statistics of the experimenter's pages, computed in a process of their own."""
