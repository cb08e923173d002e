"""Fixtures of all experiment tests: databases of both kinds, and stores on them."""

from __future__ import annotations

from support.experiment.postgres import database_url, fresh_postgres, postgres_cluster, postgres_url
from support.experiment.store_walk import small_secrets, small_study, sqlite_store, store

__all__ = [
    "database_url",
    "fresh_postgres",
    "postgres_cluster",
    "postgres_url",
    "small_secrets",
    "small_study",
    "sqlite_store",
    "store",
]
