"""The table of sessions: chosen, sorted, cut into pages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any
from urllib.parse import urlencode

from physion.experiment.experimenter.statistics.flagging import Flags
from physion.experiment.experimenter.statistics.summaries import STAGES, STATES, Summary

PAGE = 50
"""Sessions on one page."""
KINDS = {"person": "People", "simulated": "Simulated", "preview": "Previews"}
"""Kinds of sessions and what they are called."""
SORTS = (
    "reference", "scenario", "source", "state", "started", "minutes", "trials", "accuracy", "rt",
    "flags", "frames",
)  # fmt: skip
"""Columns by which the table can be sorted."""
ANY = "any"


@dataclass(frozen=True)
class Choice:
    """What of the table is shown; words that mean nothing fall back to the defaults."""

    kind: str = "person"
    scenario: str = ""
    state: str = ""
    flag: str = ""
    sort: str = "started"
    down: bool = True
    page: int = 1

    @classmethod
    def read(cls, query: Mapping[str, str], scenarios: Sequence[str]) -> Choice:
        """The choice that an address makes, ``?kind=person&state=left&sort=accuracy``."""

        def one_of(name: str, known: Sequence[str], default: str) -> str:
            given = query.get(name, default)
            return given if given in known else default

        return cls(
            kind=one_of("kind", list(KINDS), "person"),
            scenario=one_of("scenario", scenarios, ""),
            state=one_of("state", list(STATES), ""),
            flag=query.get("flag", "")[:40],
            sort=one_of("sort", SORTS, "started"),
            down=query.get("down", "1") != "0",
            page=page_number(query.get("page", "")),
        )

    def link(self, **changes: Any) -> str:
        """The address of this choice with changes; only what is not the default is named."""
        default = asdict(Choice())
        wanted = asdict(replace(self, **changes))
        words = {
            name: int(value) if isinstance(value, bool) else value
            for name, value in wanted.items()
            if value != default[name]
        }
        return "?" + urlencode(words)

    def sort_link(self, column: str) -> str:
        """Sorts by ``column``, or the other way round where it is sorted by it already."""
        down = not self.down if column == self.sort else column in ("started", "flags", "frames")
        return self.link(sort=column, down=down, page=1)


def page_number(given: str) -> int:
    """The number of a page in an address; 1 where it is none."""
    return int(given) if given.isascii() and given.isdigit() and len(given) < 7 else 1


@dataclass(frozen=True)
class Line:
    """A row of the table. ``minutes`` from the beginning to the end, or to the last sign of life;
    ``troubled``: trials not shown with all frames."""

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
    troubled: int
    hidden: int


@dataclass(frozen=True)
class SessionList:
    """One page of the table; ``found`` counts all that were chosen."""

    choice: Choice
    lines: tuple[Line, ...]
    found: int
    pages: int
    kinds: Mapping[str, int]
    rules: tuple[str, ...]


def list_sessions(summaries: Sequence[Summary], flags: Flags, choice: Choice) -> SessionList:
    """The page that was chosen; a page beyond the last is the last."""
    kinds = {kind: sum(s.facts["kind"] == kind for s in summaries) for kind in KINDS}
    chosen = [s for s in summaries if _is_chosen(s, flags, choice)]
    lines = [_line(summary, flags) for summary in chosen]
    key = _KEYS[choice.sort]
    known = [line for line in lines if key(line) is not None]
    # What is not known stands last, whichever way the rest is sorted.
    lines = sorted(known, key=key, reverse=choice.down) + [x for x in lines if key(x) is None]
    pages = max(1, -(-len(lines) // PAGE))
    page = min(max(1, choice.page), pages)
    part = tuple(lines[(page - 1) * PAGE : page * PAGE])
    return SessionList(replace(choice, page=page), part, len(lines), pages, kinds, flags.rules)


def _is_chosen(summary: Summary, flags: Flags, choice: Choice) -> bool:
    facts = summary.facts
    rules = flags_shown(summary, flags)
    return (
        facts["kind"] == choice.kind
        and choice.scenario in ("", facts["scenario"])
        and choice.state in ("", summary.state)
        and (not choice.flag or choice.flag in rules or (choice.flag == ANY and bool(rules)))
    )


def flags_shown(summary: Summary, flags: Flags) -> tuple[str, ...]:
    """The flags of a session; of one that is going on it is too early to tell."""
    return () if summary.state == "going" else flags.of(str(summary.facts["session"]))


def _line(summary: Summary, flags: Flags) -> Line:
    facts, answered = summary.facts, summary.answered
    end = facts["finished_at"] or facts["withdrawn_at"] or facts["last_seen"]
    return Line(
        facts["session"], facts["reference"], facts["scenario"], facts["source"], summary.state,
        STAGES[summary.stage], facts["started_at"], max(0.0, end - facts["started_at"]) / 60,
        answered.test, answered.accuracy, answered.median_rt, flags_shown(summary, flags),
        answered.troubled, answered.hidden,
    )  # fmt: skip


_KEYS: Mapping[str, Callable[[Line], Any]] = {
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
    "frames": lambda line: line.troubled,
}
