"""The verb ``run``: which trials, which models, and the report."""
