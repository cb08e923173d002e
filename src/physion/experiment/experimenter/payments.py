"""Payments: one row per session of a person whose recruiter's id is stored; also as CSV."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from statistics import median

from sqlalchemy import Engine, func, select

from physion.core.tables import FORMULA
from physion.experiment.experimenter.progress import SessionLine
from physion.experiment.store.database import RAW_IDS
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import completion
from physion.experiment.study.settings import Bonus, PaymentRule
from physion.experiment.study.study import Study

COLUMNS = (
    "source", "id", "reference", "scenario", "state", "finished_at", "test_trials", "correct",
    "accuracy", "flags", "payment", "bonus", "completion_code", "recruiter",
)  # fmt: skip


@dataclass(frozen=True)
class Payment:
    """Session of a person with the raw id.

    Attributes
    ----------
    line
        The session. An implausible one is not paid without a look at it: its code was not shown to
        the participant.
    raw_id, recruiter
        Id at the recruiter, and further parameters of the entry URL.
    code
        Completion code of a finished session.
    amount, bonus
        In the lab's currency: what everyone who finishes receives, and what right answers add.
    """

    line: SessionLine
    raw_id: str
    recruiter: Mapping[str, str]
    code: str | None
    amount: float
    bonus: float


def read_payments(
    study: Study, secrets: Secrets, engine: Engine, lines: Sequence[SessionLine], finished: bool
) -> tuple[list[Payment], int]:
    """Return the payments of these sessions of people, and the number of stored raw ids.

    ``finished``: only of finished sessions.
    """
    with engine.connect() as connection:
        stored = connection.scalar(select(func.count()).select_from(RAW_IDS)) or 0
        ids = {row.participant: row for row in connection.execute(select(RAW_IDS))}
    payments = []
    for line in lines:
        raw = ids.get(line.row.participant)
        done = line.row.finished_at is not None
        if raw is None or (finished and not done):
            continue
        code = completion(study, secrets, line.row, raw).code if done else None
        amount = study.payment.amount if line.state == "finished" else 0.0
        bonus = bonus_of(study.bonus, line)
        payments.append(Payment(line, raw.raw_id, raw.recruiter, code, amount, bonus))
    return payments, stored


def bonus_of(rule: Bonus, line: SessionLine) -> float:
    """Return the bonus in the lab's currency, rounded to cents; 0 unless the session is finished.

    ``bonus = min(most, per_correct · max(0, correct - above · trials))``, with no upper limit if
    ``most`` is 0.
    """
    if line.state != "finished":
        return 0.0
    counted = max(0.0, line.correct - rule.above * line.trials)
    amount = rule.per_correct * counted
    return round(min(amount, rule.most) if rule.most else amount, 2)


@dataclass(frozen=True)
class Wage:
    """What the payment is per hour, at the median duration of the finished sessions."""

    sessions: int
    minutes: float
    per_hour: float
    enough: bool


def measured_wage(rule: PaymentRule, lines: Sequence[SessionLine]) -> Wage | None:
    """Return the measured wage without bonus; None without payment or finished sessions."""
    lasted = [line.minutes for line in lines if line.counts]
    if not (rule.amount and lasted):
        return None
    middle = median(lasted)
    hourly = 60 * rule.amount / middle if middle else float("inf")
    return Wage(len(lasted), middle, hourly, hourly >= rule.least_per_hour)


def payment_csv(payments: Sequence[Payment]) -> bytes:
    """Return the payments as CSV with `COLUMNS`; texts are protected against formulas."""
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(COLUMNS)
    for payment in payments:
        line = payment.line
        finished_at = line.row.finished_at
        texts = (
            line.row.source,
            payment.raw_id,
            line.row.reference,
            line.row.scenario,
            line.state,
            ""
            if finished_at is None
            else datetime.fromtimestamp(finished_at, UTC).isoformat("T", "seconds"),
            str(line.trials),
            str(line.correct),
            "" if line.accuracy is None else f"{line.accuracy:.4f}",
            " ".join(line.flags),
            f"{payment.amount:.2f}",
            f"{payment.bonus:.2f}",
            payment.code or "",
            json.dumps(dict(payment.recruiter), ensure_ascii=False) if payment.recruiter else "",
        )
        writer.writerow([re.sub(FORMULA, r"'\1", text) for text in texts])
    return lines.getvalue().encode()
