"""Database of sessions and answers."""
