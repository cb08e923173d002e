"""Entering a study: who the visitor is, and what a new session is assigned."""
