"""Export in the official file formats."""
