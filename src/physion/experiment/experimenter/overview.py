"""The overview: how far each scenario is, where people stop, how they do, how movies were shown."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from statistics import fmean, median, stdev

from physion.experiment.experimenter.figures import Histogram, accuracy_histogram, rt_histogram
from physion.experiment.experimenter.statistics.flagging import Flags
from physion.experiment.experimenter.statistics.summaries import STAGES, STATES, Summary
from physion.experiment.study.study import Study

RATE_OVER = 20
"""So many of the last finishers tell the present rate, ..."""
RATE_FROM = 3
"""... no fewer than these, ..."""
RATE_WITHIN = 86_400.0
"""... and none of them longer ago than this, in seconds."""


@dataclass(frozen=True)
class Progress:
    """A row of the table of progress. ``flagged`` counts finished sessions, None while not known;
    ``done_at`` is when the last one is expected to finish at the present rate, None where there is
    no telling. ``states`` counts sessions by `STATES`."""

    scenario: str
    wanted: int
    states: Mapping[str, int]
    flagged: int | None
    done_at: float | None

    @property
    def share(self) -> float:
        """Finished of wanted in %, at most 100."""
        return min(100.0, 100.0 * self.states["finished"] / self.wanted) if self.wanted else 0.0


@dataclass(frozen=True)
class Step:
    """A row of the funnel: how many reached a stage, how many ended there, how many are in it."""

    name: str
    reached: int
    share: float
    going: int
    left: int
    withdrawn: int


@dataclass(frozen=True)
class Performance:
    """How the people of a scenario did who answered all test trials; None where there are none.
    ``margin``: half of a 95 % confidence interval of the mean."""

    scenario: str
    people: int
    accuracy: float | None
    margin: float | None
    accuracies: Histogram
    median_rt_ms: float | None
    times: Histogram


@dataclass(frozen=True)
class Shown:
    """How the movies of some trials were shown, as counts of trials; see `summaries.Answered`."""

    name: str
    sessions: int
    trials: int
    full: int
    short: int
    over: int
    unknown: int
    dropped: int
    hidden: int

    @property
    def share(self) -> float | None:
        """Trials with all frames in %, of those whose number of frames is known."""
        known = self.trials - self.unknown
        return 100.0 * self.full / known if known else None


@dataclass(frozen=True)
class Overview:
    """All that the overview shows, of sessions of one kind."""

    kind: str
    sessions: int
    kinds: Mapping[str, int]
    progress: tuple[Progress, ...]
    total: Progress
    funnel: tuple[Step, ...]
    performance: tuple[Performance, ...]
    shown: Shown
    browsers: tuple[Shown, ...]
    refresh_rates: tuple[Shown, ...]
    rules: tuple[tuple[str, tuple[int, ...]], ...]


def look_over(
    study: Study, summaries: Sequence[Summary], flags: Flags, now: float, kind: str
) -> Overview:
    """The overview of the sessions of a ``kind``."""
    chosen = [summary for summary in summaries if summary.facts["kind"] == kind]
    by_scenario = {
        name: [s for s in chosen if s.facts["scenario"] == name] for name in study.scenarios
    }
    rows = tuple(
        _progress(name, study.participants, part, flags, now) for name, part in by_scenario.items()
    )
    return Overview(
        kind,
        len(chosen),
        Counter(str(summary.facts["kind"]) for summary in summaries),
        rows,
        _total(rows, chosen, flags),
        funnel(chosen),
        tuple(_performance(study, name, part) for name, part in by_scenario.items()),
        _shown("All", chosen),
        _grouped(chosen, lambda s: browser_of(str(s.facts["device"].get("user_agent", "")))),
        _grouped(chosen, lambda s: rate_of(s.facts["device"].get("refresh_hz"))),
        _rules(list(by_scenario.values()), flags),
    )


def _progress(
    name: str, wanted: int, part: Sequence[Summary], flags: Flags, now: float
) -> Progress:
    states = Counter(summary.state for summary in part)
    counts = {state: states[state] for state in STATES}
    finished = [float(s.facts["finished_at"]) for s in part if s.state == "finished"]
    return Progress(
        name, wanted, counts, _flagged(part, flags), expected_end(finished, wanted, now)
    )


def _total(rows: Sequence[Progress], part: Sequence[Summary], flags: Flags) -> Progress:
    """All scenarios together; their end is that of the last, where all of them can be told."""
    counts = {state: sum(row.states[state] for row in rows) for state in STATES}
    open_rows = [row for row in rows if row.states["finished"] < row.wanted]
    ends = [row.done_at for row in open_rows]
    known = [end for end in ends if end is not None]
    done_at = max(known) if known and len(known) == len(ends) else None
    return Progress("All", sum(r.wanted for r in rows), counts, _flagged(part, flags), done_at)


def _flagged(part: Sequence[Summary], flags: Flags) -> int | None:
    if not flags.are_known:
        return None
    return sum(s.state == "finished" and bool(flags.of(s.facts["session"])) for s in part)


def expected_end(finished: Sequence[float], wanted: int, now: float) -> float | None:
    """When ``wanted`` sessions will have finished, at the rate of the last `RATE_OVER` of them.

    The rate counts the time since the last one too, so that it falls when nobody comes any more.
    None where enough have finished, or too few lately for a rate.
    """
    missing = wanted - len(finished)
    lately = sorted(t for t in finished if now - t <= RATE_WITHIN)[-RATE_OVER:]
    if missing <= 0 or len(lately) < RATE_FROM or now <= lately[0]:
        return None
    return now + missing * (now - lately[0]) / (len(lately) - 1)


def funnel(part: Sequence[Summary]) -> tuple[Step, ...]:
    """Every stage with those who reached it, and those who are there or ended there."""
    order = list(STAGES)
    at = {stage: Counter(s.state for s in part if s.stage == stage) for stage in order}
    steps = []
    for place, stage in enumerate(order):
        reached = sum(at[later].total() for later in order[place:])
        share = 100.0 * reached / len(part) if part else 0.0
        here = at[stage]
        gone = here["withdrawn"] + here["declined"]
        steps.append(Step(STAGES[stage], reached, share, here["going"], here["left"], gone))
    return tuple(steps)


def _performance(study: Study, name: str, part: Sequence[Summary]) -> Performance:
    trials = len(study.phase(name, "test"))
    whole = [s.answered for s in part if trials and s.answered.test >= trials]
    shares = [answered.correct / answered.test for answered in whole]
    times = list(chain.from_iterable(answered.rt_ms for answered in whole))
    margin = 1.96 * stdev(shares) / math.sqrt(len(shares)) if len(shares) > 1 else None
    return Performance(
        name,
        len(whole),
        fmean(shares) if shares else None,
        margin,
        accuracy_histogram(shares),
        median(times) if times else None,
        rt_histogram(times),
    )


def _shown(name: str, part: Sequence[Summary]) -> Shown:
    found = [summary.answered for summary in part if summary.answered.trials]
    names = ("trials", "full", "short", "over", "unknown", "dropped", "hidden")
    return Shown(name, len(found), *(sum(getattr(a, word) for a in found) for word in names))


def _grouped(part: Sequence[Summary], name_of: Callable[[Summary], str]) -> tuple[Shown, ...]:
    groups: dict[str, list[Summary]] = {}
    for summary in part:
        if summary.answered.trials:
            groups.setdefault(name_of(summary), []).append(summary)
    found = [_shown(name, members) for name, members in groups.items()]
    return tuple(sorted(found, key=lambda shown: -shown.trials))


def _rules(
    parts: Sequence[Sequence[Summary]], flags: Flags
) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Each rule with the finished sessions that it flags, by scenario."""
    if not flags.are_known:
        return ()
    done = [[s.facts["session"] for s in part if s.state == "finished"] for part in parts]
    return tuple(
        (rule, tuple(sum(rule in flags.of(name) for name in names) for names in done))
        for rule in flags.rules
    )


_BROWSERS = (
    ("Edge", r"Edg(?:e|A|iOS)?/(\d+)"),
    ("Opera", r"OPR/(\d+)"),
    ("Samsung Internet", r"SamsungBrowser/(\d+)"),
    ("Firefox", r"(?:Firefox|FxiOS)/(\d+)"),
    ("Chrome", r"(?:Headless)?(?:Chrome|CriOS)/(\d+)"),
    ("Safari", r"Version/(\d+)\S* (?:Mobile/\S+ )?Safari/"),
)


def browser_of(user_agent: str) -> str:
    """Name and main version, as ``Firefox 140``; ``other`` where none of the usual ones."""
    for name, pattern in _BROWSERS:
        found = re.search(pattern, user_agent[:1000])
        if found:
            return f"{name} {found[1]}"
    return "other" if user_agent else "not known"


def rate_of(refresh_hz: object) -> str:
    """The usual rate of screens that is within 3 % of a measured one, else to 5 Hz."""
    if not isinstance(refresh_hz, int | float) or not refresh_hz > 0:
        return "not known"
    for usual in (30, 50, 60, 75, 90, 100, 120, 144, 165, 240):
        if abs(refresh_hz - usual) <= 0.03 * usual:
            return f"{usual} Hz"
    return f"about {5 * round(refresh_hz / 5)} Hz"
