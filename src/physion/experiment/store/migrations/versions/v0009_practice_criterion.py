"""Version 9: repeats of the practice, and checks of the lab that a session failed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Add the columns and the table of answers to a practice that was repeated."""
    repeats = sa.Column("practice_repeats", sa.Integer(), nullable=False, server_default="0")
    op.add_column("sessions", repeats)
    op.add_column("sessions", sa.Column("failed_checks", sa.String(length=100)))
    op.create_table(
        "practice_repeats",
        sa.Column("session", sa.String(length=32), nullable=False),
        sa.Column("phase", sa.String(length=15), nullable=False),
        sa.Column("trial", sa.Integer(), nullable=False),
        sa.Column("repeat", sa.Integer(), nullable=False),
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("stimulus", sa.String(length=200), nullable=False),
        sa.Column("response", sa.String(length=3), nullable=False),
        sa.Column("rt_ms", sa.Float(), nullable=False),
        sa.Column("input", sa.String(length=8), nullable=False),
        sa.Column("fixation_ms", sa.Float()),
        sa.Column("cue_ms", sa.Float()),
        sa.Column("frames_expected", sa.Integer(), nullable=False),
        sa.Column("frames_shown", sa.Integer()),
        sa.Column("frames_dropped", sa.Integer()),
        sa.Column("movie_ms", sa.Float()),
        sa.Column("visibility_changes", sa.Integer()),
        sa.Column("window_width", sa.Integer()),
        sa.Column("window_height", sa.Integer()),
        sa.Column("break_ms", sa.Float()),
        sa.Column("resumed", sa.Boolean(), nullable=False),
        sa.Column("showings", sa.Integer()),
        sa.Column("void", sa.String(length=10)),
        sa.Column("answered_at", sa.Float(), nullable=False),
        sa.Column("details", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["session"], ["sessions.session"], name=op.f("fk_practice_repeats_session")
        ),
        sa.PrimaryKeyConstraint(
            "session", "phase", "trial", "repeat", name=op.f("pk_practice_repeats")
        ),
    )
