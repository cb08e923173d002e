"""Models compared with people."""
