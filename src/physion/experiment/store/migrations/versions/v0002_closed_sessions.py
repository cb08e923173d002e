"""Version 2: the time at which a session was closed for good."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add the column; the sessions whose data were deleted (they have no device) are closed."""
    op.add_column("sessions", sa.Column("closed_at", sa.Float()))
    op.execute(
        "UPDATE sessions SET closed_at = withdrawn_at WHERE withdrawn_at IS NOT NULL "
        "AND consented_at IS NOT NULL AND CAST(device AS TEXT) = '{}'"
    )
