"""Version 8: attempts at the comprehension check, and sessions that were screened out."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Add the columns."""
    op.add_column("sessions", sa.Column("comprehended_at", sa.Float()))
    attempts = sa.Column("comprehension_attempts", sa.Integer(), nullable=False, server_default="0")
    op.add_column("sessions", attempts)
    op.add_column("sessions", sa.Column("screened_out_at", sa.Float()))
    op.add_column("sessions", sa.Column("screened_out_by", sa.String(length=20)))
