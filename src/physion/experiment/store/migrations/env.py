"""Alembic environment: apply the migrations on the connection given by `database.upgrade`."""

from __future__ import annotations

from alembic import context

from physion.experiment.store.database import METADATA

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=METADATA,
    # SQLite cannot alter a column; batch mode copies the table instead.
    render_as_batch=True,
)
with context.begin_transaction():
    context.run_migrations()
