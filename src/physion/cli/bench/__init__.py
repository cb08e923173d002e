"""Benchmarks on the machine of the user: the verb, and what it measures."""
