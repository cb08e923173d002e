"""Fixtures of all experiment tests: a small study, and stores of it."""

from __future__ import annotations

from support.experiment.store_walk import database, small_secrets, small_study, store

__all__ = ["database", "small_secrets", "small_study", "store"]
