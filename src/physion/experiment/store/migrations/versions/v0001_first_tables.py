"""Version 1: the first tables. Does not import `tables.py`, which describes the newest version."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create all tables."""
    op.create_table(
        "participants",
        sa.Column("participant", sa.String(length=32), nullable=False),
        sa.Column("first_seen", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("participant", name=op.f("pk_participants")),
    )
    op.create_table(
        "raw_ids",
        sa.Column("participant", sa.String(length=32), nullable=False),
        sa.Column("source", sa.String(length=20), nullable=False),
        sa.Column("raw_id", sa.String(length=200), nullable=False),
        sa.Column("recruiter", sa.JSON(), nullable=False),
        sa.Column("seen", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("participant", name=op.f("pk_raw_ids")),
    )
    op.create_table(
        "studies",
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("version", sa.String(length=200), nullable=False),
        sa.Column("stimuli_digest", sa.String(length=64), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("first_served", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_studies")),
    )
    op.create_table(
        "sessions",
        sa.Column("session", sa.String(length=32), nullable=False),
        sa.Column("participant", sa.String(length=32), nullable=False),
        sa.Column("scenario", sa.String(length=200), nullable=False),
        sa.Column("kind", sa.String(length=10), nullable=False),
        sa.Column("source", sa.String(length=20), nullable=False),
        sa.Column("study", sa.String(length=64), nullable=False),
        sa.Column("reference", sa.String(length=20), nullable=False),
        sa.Column("order_seed", sa.BigInteger(), nullable=False),
        sa.Column("order_number", sa.Integer(), nullable=False),
        sa.Column("buttons", sa.String(length=6), nullable=False),
        sa.Column("language", sa.String(length=20), nullable=False),
        sa.Column("started_at", sa.Float(), nullable=False),
        sa.Column("consent_version", sa.String(length=200), nullable=True),
        sa.Column("consented_at", sa.Float(), nullable=True),
        sa.Column("instructed_at", sa.Float(), nullable=True),
        sa.Column("ready_at", sa.Float(), nullable=True),
        sa.Column("demographics_at", sa.Float(), nullable=True),
        sa.Column("finished_at", sa.Float(), nullable=True),
        sa.Column("withdrawn_at", sa.Float(), nullable=True),
        sa.Column("answered_familiarization", sa.Integer(), nullable=False),
        sa.Column("answered_test", sa.Integer(), nullable=False),
        sa.Column("loads", sa.Integer(), nullable=False),
        sa.Column("loaded_at_phase", sa.String(length=15), nullable=True),
        sa.Column("loaded_at_trial", sa.Integer(), nullable=True),
        sa.Column("last_seen", sa.Float(), nullable=False),
        sa.Column("age", sa.Integer(), nullable=True),
        sa.Column("gender", sa.String(length=200), nullable=True),
        sa.Column("education", sa.String(length=200), nullable=True),
        sa.Column("difficulty", sa.Integer(), nullable=True),
        sa.Column("technical_problems", sa.Boolean(), nullable=True),
        sa.Column("feedback", sa.Text(), nullable=True),
        sa.Column("device", sa.JSON(), nullable=False),
        sa.CheckConstraint("buttons IN ('yes-no', 'no-yes')", name=op.f("ck_sessions_buttons")),
        sa.CheckConstraint(
            "kind IN ('person', 'simulated', 'preview')", name=op.f("ck_sessions_kind")
        ),
        sa.ForeignKeyConstraint(
            ["participant"], ["participants.participant"], name=op.f("fk_sessions_participant")
        ),
        sa.ForeignKeyConstraint(["study"], ["studies.digest"], name=op.f("fk_sessions_study")),
        sa.PrimaryKeyConstraint("session", name=op.f("pk_sessions")),
        sa.UniqueConstraint(
            "participant", "scenario", name=op.f("uq_sessions_participant_scenario")
        ),
    )
    op.create_index("ix_sessions_scenario_kind", "sessions", ["scenario", "kind"], unique=False)
    op.create_table(
        "answers",
        sa.Column("session", sa.String(length=32), nullable=False),
        sa.Column("phase", sa.String(length=15), nullable=False),
        sa.Column("trial", sa.Integer(), nullable=False),
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("stimulus", sa.String(length=200), nullable=False),
        sa.Column("response", sa.String(length=3), nullable=False),
        sa.Column("rt_ms", sa.Float(), nullable=False),
        sa.Column("input", sa.String(length=8), nullable=False),
        sa.Column("fixation_ms", sa.Float(), nullable=True),
        sa.Column("cue_ms", sa.Float(), nullable=True),
        sa.Column("frames_expected", sa.Integer(), nullable=False),
        sa.Column("frames_shown", sa.Integer(), nullable=True),
        sa.Column("frames_dropped", sa.Integer(), nullable=True),
        sa.Column("movie_ms", sa.Float(), nullable=True),
        sa.Column("visibility_changes", sa.Integer(), nullable=True),
        sa.Column("window_width", sa.Integer(), nullable=True),
        sa.Column("window_height", sa.Integer(), nullable=True),
        sa.Column("resumed", sa.Boolean(), nullable=False),
        sa.Column("answered_at", sa.Float(), nullable=False),
        sa.Column("details", sa.Text(), nullable=False),
        sa.CheckConstraint("response IN ('yes', 'no')", name=op.f("ck_answers_response")),
        sa.ForeignKeyConstraint(["session"], ["sessions.session"], name=op.f("fk_answers_session")),
        sa.PrimaryKeyConstraint("session", "phase", "trial", name=op.f("pk_answers")),
        sa.UniqueConstraint("session", "key", name=op.f("uq_answers_session_key")),
        sa.UniqueConstraint(
            "session", "phase", "stimulus", name=op.f("uq_answers_session_phase_stimulus")
        ),
    )
    op.create_table(
        "events",
        sa.Column("event", sa.Integer(), autoincrement=True, nullable=False),
        sa.Column("session", sa.String(length=32), nullable=False),
        sa.Column("batch", sa.String(length=64), nullable=True),
        sa.Column("kind", sa.String(length=40), nullable=False),
        sa.Column("at_ms", sa.Float(), nullable=False),
        sa.Column("stored_at", sa.Float(), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["session"], ["sessions.session"], name=op.f("fk_events_session")),
        sa.PrimaryKeyConstraint("event", name=op.f("pk_events")),
    )
    op.create_index(op.f("ix_events_session"), "events", ["session"], unique=False)
    op.create_table(
        "tokens",
        sa.Column("token_hash", sa.String(length=64), nullable=False),
        sa.Column("session", sa.String(length=32), nullable=False),
        sa.Column("made", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["session"], ["sessions.session"], name=op.f("fk_tokens_session")),
        sa.PrimaryKeyConstraint("token_hash", name=op.f("pk_tokens")),
    )
    op.create_index(op.f("ix_tokens_session"), "tokens", ["session"], unique=False)
