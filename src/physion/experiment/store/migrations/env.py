"""Run by Alembic: applies the versions on the connection that `database.upgrade` hands over."""

from __future__ import annotations

from alembic import context

from physion.experiment.store.tables import METADATA

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=METADATA,
    # SQLite cannot alter a column: later versions copy the table.
    render_as_batch=True,
)
with context.begin_transaction():
    context.run_migrations()
