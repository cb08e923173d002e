"""What a model may see of a trial, and the batches that it receives."""
