"""Version 4: pauses of recruitment, and the time at which a session was made void."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add table and column."""
    op.create_table(
        "pauses",
        sa.Column("paused_at", sa.Float(), nullable=False),
        sa.Column("resumed_at", sa.Float()),
        sa.PrimaryKeyConstraint("paused_at", name=op.f("pk_pauses")),
    )
    op.add_column("sessions", sa.Column("voided_at", sa.Float()))
