"""Features of trials: computed by models, stored in files, read piece by piece."""
