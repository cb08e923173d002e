"""The database of sessions and answers."""
