"""Version 6: answers to the lab's own questions."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Add the columns."""
    op.add_column("sessions", sa.Column("questions_at", sa.Float()))
    op.add_column("sessions", sa.Column("questions_study", sa.String(length=64)))
    op.add_column("sessions", sa.Column("own_answers", sa.JSON()))
