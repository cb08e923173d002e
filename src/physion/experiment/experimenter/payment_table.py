"""The table of payments as CSV: one row per session of a person whose raw id is stored."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from physion.experiment.experimenter.payments import Payment
from physion.experiment.experimenter.session_list import flags_shown
from physion.experiment.experimenter.statistics.flagging import Flags
from physion.experiment.experimenter.statistics.summaries import SessionSummary
from physion.experiment.export.spreadsheet import guard_cell
from physion.experiment.study.study import Bonus

COLUMNS = (
    "source", "id", "reference", "scenario", "state", "finished_at", "test_trials", "correct",
    "accuracy", "flags", "bonus", "completion_code", "recruiter",
)  # fmt: skip


@dataclass(frozen=True)
class Performance:
    """What a payment may depend on: number of test answers, of right ones, state and flags."""

    state: str
    trials: int
    correct: int
    flags: tuple[str, ...]

    @property
    def accuracy(self) -> float | None:
        """Fraction of right test answers; None without answers."""
        return self.correct / self.trials if self.trials else None


def performances(summaries: Sequence[SessionSummary], flags: Flags) -> dict[str, Performance]:
    """Return the performance in each session of a person."""
    return {
        str(summary.facts["session"]): Performance(
            summary.state,
            summary.answered.test,
            summary.answered.correct,
            flags_shown(summary, flags),
        )
        for summary in summaries
        if summary.facts["kind"] == "person"
    }


def bonus_of(rule: Bonus, performance: Performance) -> float:
    """Return the bonus in the lab's currency, rounded to cents; 0 unless the session is finished.

    ``bonus = min(most, per_correct · max(0, correct - above · trials))``, with no upper limit if
    ``most`` is 0.
    """
    if performance.state != "finished":
        return 0.0
    counted = max(0.0, performance.correct - rule.above * performance.trials)
    amount = rule.per_correct * counted
    return round(min(amount, rule.most) if rule.most else amount, 2)


def payment_csv(rows: Sequence[Payment], known: Mapping[str, Performance], rule: Bonus) -> bytes:
    """Return the payments as CSV with `COLUMNS`; texts are protected against formulas."""
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        done = known.get(row.session, Performance("", row.trials, 0, ()))
        accuracy = "" if done.accuracy is None else f"{done.accuracy:.4f}"
        texts = (
            row.source, row.raw_id, row.reference, row.scenario, done.state,
            _iso_time(row.finished_at), str(done.trials), str(done.correct), accuracy,
            " ".join(done.flags), f"{bonus_of(rule, done):.2f}", row.code or "",
            json.dumps(dict(row.recruiter), ensure_ascii=False) if row.recruiter else "",
        )  # fmt: skip
        writer.writerow([guard_cell(text) for text in texts])
    return lines.getvalue().encode()


def _iso_time(seconds: float | None) -> str:
    """Return a Unix time in ISO 8601, or an empty text."""
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat("T", "seconds")
