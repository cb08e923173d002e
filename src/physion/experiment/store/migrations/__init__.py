"""Alembic migrations of the tables, one file per version, applied when a study is served."""
