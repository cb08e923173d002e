"""Version 3: the duration of the break before a trial."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the column."""
    op.add_column("answers", sa.Column("break_ms", sa.Float()))
