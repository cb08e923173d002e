"""The eight scenarios, one file each."""
