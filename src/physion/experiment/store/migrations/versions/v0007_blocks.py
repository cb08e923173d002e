"""Version 7: sessions of several scenarios, one block each."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Add the index of the current block; known sessions have one block."""
    op.add_column("sessions", sa.Column("block_at", sa.Float()))
    op.add_column("sessions", sa.Column("block", sa.Integer(), nullable=False, server_default="0"))
