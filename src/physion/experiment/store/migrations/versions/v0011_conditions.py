"""Version 11: between-subject conditions."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Add the condition of a session; known sessions have none."""
    op.add_column("sessions", sa.Column("condition", sa.String(length=40)))
