"""Page that shows a dataset."""
