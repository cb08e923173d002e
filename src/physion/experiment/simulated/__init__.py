"""Simulated participants, who test a study before people do."""
