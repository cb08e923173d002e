"""Login to the experimenter's pages."""
