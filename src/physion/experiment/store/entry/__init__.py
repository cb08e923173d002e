"""Entering a study: who the visitor is, what a new session is assigned, and how one continues."""
