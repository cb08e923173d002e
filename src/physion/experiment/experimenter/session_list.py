"""The table of sessions: filtering, sorting and pagination."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any
from urllib.parse import urlencode

from physion.experiment.experimenter.statistics.flagging import Flags
from physion.experiment.experimenter.statistics.summaries import STATES, SessionSummary
from physion.experiment.protocol import label
from physion.experiment.study.study import Study

PAGE = 50
"""Sessions per page."""
KINDS = {"person": "People", "simulated": "Simulated", "preview": "Previews"}
"""Kinds of sessions and their labels."""
SORTS = (
    "reference", "scenario", "source", "state", "started", "minutes", "trials", "accuracy", "rt",
    "flags", "frames",
)  # fmt: skip
"""Columns by which the table can be sorted."""
ANY = "any"


@dataclass(frozen=True)
class SessionFilter:
    """Filter, sort order and page of the table, as given in the query of the URL."""

    kind: str = "person"
    scenario: str = ""
    condition: str = ""
    state: str = ""
    flag: str = ""
    sort: str = "started"
    down: bool = True
    page: int = 1

    @classmethod
    def from_query(cls, query: Mapping[str, str], study: Study) -> SessionFilter:
        """Parse a query such as ``?kind=person&state=left``; invalid values give the defaults."""
        conditions = [condition.name for condition in study.conditions]

        def one_of(name: str, known: Sequence[str], default: str) -> str:
            given = query.get(name, default)
            return given if given in known else default

        return cls(
            kind=one_of("kind", list(KINDS), "person"),
            scenario=one_of("scenario", study.offered, ""),
            condition=one_of("condition", conditions, ""),
            state=one_of("state", list(STATES), ""),
            flag=query.get("flag", "")[:40],
            sort=one_of("sort", SORTS, "started"),
            down=query.get("down", "1") != "0",
            page=page_number(query.get("page", "")),
        )

    def link(self, **changes: Any) -> str:
        """Return the query of this filter with some values changed, without default values."""
        default = asdict(SessionFilter())
        wanted = asdict(replace(self, **changes))
        query = {
            name: int(value) if isinstance(value, bool) else value
            for name, value in wanted.items()
            if value != default[name]
        }
        return "?" + urlencode(query)

    def sort_link(self, column: str) -> str:
        """Return the query that sorts by ``column``; or reverses the current order."""
        down = not self.down if column == self.sort else column in ("started", "flags", "frames")
        return self.link(sort=column, down=down, page=1)


def page_number(given: str) -> int:
    """Parse a page number in a query; return 1 if it is invalid."""
    return int(given) if given.isascii() and given.isdigit() and len(given) < 7 else 1


@dataclass(frozen=True)
class SessionLine:
    """Row of the table of sessions.

    ``minutes`` is the duration to the end of the session, or to its last request. ``incomplete``
    counts trials whose movie was not displayed with all frames.
    """

    session: str
    reference: str
    scenario: str
    source: str
    state: str
    stage: str
    started: float
    minutes: float
    trials: int
    accuracy: float | None
    rt_ms: float | None
    flags: tuple[str, ...]
    incomplete: int
    hidden: int


@dataclass(frozen=True)
class SessionList:
    """One page of the table; ``total`` counts the selected sessions on all pages."""

    choice: SessionFilter
    lines: tuple[SessionLine, ...]
    total: int
    pages: int
    kinds: Mapping[str, int]
    rules: tuple[str, ...]


def list_sessions(
    summaries: Sequence[SessionSummary], flags: Flags, choice: SessionFilter
) -> SessionList:
    """Return the selected page; a number beyond the last page gives the last page."""
    kinds = {kind: sum(s.facts["kind"] == kind for s in summaries) for kind in KINDS}
    chosen = [s for s in summaries if _is_chosen(s, flags, choice)]
    lines = [_line(summary, flags) for summary in chosen]
    key = _KEYS[choice.sort]
    known = [line for line in lines if key(line) is not None]
    # Missing values come last in either sort order.
    lines = sorted(known, key=key, reverse=choice.down) + [x for x in lines if key(x) is None]
    pages = max(1, -(-len(lines) // PAGE))
    page = min(max(1, choice.page), pages)
    part = tuple(lines[(page - 1) * PAGE : page * PAGE])
    return SessionList(replace(choice, page=page), part, len(lines), pages, kinds, flags.rules)


def _is_chosen(summary: SessionSummary, flags: Flags, choice: SessionFilter) -> bool:
    """Return whether a session passes the filter."""
    facts = summary.facts
    rules = flags_shown(summary, flags)
    return (
        facts["kind"] == choice.kind
        and choice.scenario in ("", facts["scenario"])
        and choice.condition in ("", facts["condition"])
        and choice.state in ("", summary.state)
        and (not choice.flag or choice.flag in rules or (choice.flag == ANY and bool(rules)))
    )


def flags_shown(summary: SessionSummary, flags: Flags) -> tuple[str, ...]:
    """Return the flags of a session; none while it is in progress, since they may change."""
    return () if summary.state == "going" else flags.of(str(summary.facts["session"]))


def _line(summary: SessionSummary, flags: Flags) -> SessionLine:
    """Return the row of the table for one session."""
    facts, answered = summary.facts, summary.answered
    end = facts["finished_at"] or facts["withdrawn_at"] or facts["last_seen"]
    return SessionLine(
        facts["session"], facts["reference"], facts["scenario"], facts["source"], summary.state,
        label(summary.stage), facts["started_at"], max(0.0, end - facts["started_at"]) / 60,
        answered.test, answered.accuracy, answered.median_rt, flags_shown(summary, flags),
        answered.incomplete, answered.hidden,
    )  # fmt: skip


_KEYS: Mapping[str, Callable[[SessionLine], Any]] = {
    "reference": lambda line: line.reference,
    "scenario": lambda line: line.scenario,
    "source": lambda line: line.source,
    "state": lambda line: list(STATES).index(line.state),
    "started": lambda line: line.started,
    "minutes": lambda line: line.minutes,
    "trials": lambda line: line.trials,
    "accuracy": lambda line: line.accuracy,
    "rt": lambda line: line.rt_ms,
    "flags": lambda line: len(line.flags),
    "frames": lambda line: line.incomplete,
}
