"""Simulated participants, for testing a served study before people take part."""
