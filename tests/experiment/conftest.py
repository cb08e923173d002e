"""Fixtures of all tests of the experiment: databases of both kinds."""

from __future__ import annotations

from postgres import database_url, fresh_postgres, postgres_cluster, postgres_url

__all__ = ["database_url", "fresh_postgres", "postgres_cluster", "postgres_url"]
