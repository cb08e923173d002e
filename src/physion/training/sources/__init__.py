"""Sources of batches: from movies, from rendering on demand, and from states."""
