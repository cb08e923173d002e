"""Version 5: showings of trials, and what tells impossible sessions from those of people."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the table of showings and the columns; known sessions are taken to be plausible."""
    op.add_column("sessions", sa.Column("browser", sa.String(length=32)))
    op.add_column("sessions", sa.Column("progressed_at", sa.Float()))
    op.add_column("sessions", sa.Column("next_from", sa.Float()))
    for name in ("fast_answers", "unfetched", "replayed"):
        op.add_column("sessions", sa.Column(name, sa.Integer(), nullable=False, server_default="0"))
    op.add_column("sessions", sa.Column("implausible", sa.String(length=100)))
    op.add_column("answers", sa.Column("showings", sa.Integer()))
    op.add_column("answers", sa.Column("void", sa.String(length=10)))
    op.create_table(
        "showings",
        sa.Column("session", sa.String(length=32), nullable=False),
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("phase", sa.String(length=15), nullable=False),
        sa.Column("trial", sa.Integer(), nullable=False),
        sa.Column("began_at", sa.Float(), nullable=False),
        sa.Column("stored_at", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(
            ["session"], ["sessions.session"], name=op.f("fk_showings_session")
        ),
        sa.PrimaryKeyConstraint("session", "key", name=op.f("pk_showings")),
    )
    op.create_index(
        "ix_showings_session_phase_trial", "showings", ["session", "phase", "trial"], unique=False
    )
