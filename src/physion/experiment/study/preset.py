"""Settings of the study in the paper, and the mental rotation of its preregistration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from physion.experiment.study.settings import PaymentRule, Question, Timing

MENTAL_ROTATION = Question(
    "mental_rotation",
    "choice",
    options=("a", "b", "c", "d"),
    picture="mental_rotation.png",
    right="c",
)
"""One item: a figure of cubes, and four of which one is the same figure, turned. Picture and texts
ship with the package (drawn by docs/mental_rotation.py)."""

SHIPPED = {MENTAL_ROTATION.name: MENTAL_ROTATION}
"""Questions whose pictures and texts ship with the package, by name."""

PAPER: Mapping[str, Any] = {
    "timing": Timing(fixation_in_familiarization=False, break_every=0),
    "exclusions": "preregistered-only",
    "payment": PaymentRule(amount=4.0, currency="USD", minutes=20, least_per_hour=12.0),
    "questions": (MENTAL_ROTATION,),
}
"""What differs from the defaults, by the field of `StudySettings`: as the paper and its
preregistration say, test trials follow without rest, people are paid $4, which corresponds to $12
per hour, only preregistered rules exclude sessions, and one item of spatial reasoning is asked."""
