"""Version 12: failed attention checks."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the column."""
    failed = sa.Column("attention_failed", sa.Integer(), nullable=False, server_default="0")
    op.add_column("sessions", failed)
