"""Statistics of the overview page: progress, drop-out, accuracy and how movies were displayed."""

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
from physion.experiment.experimenter.statistics.summaries import (
    STATES,
    SessionSummary,
    stages_shown,
)
from physion.experiment.protocol import label
from physion.experiment.study.orders import session_trials
from physion.experiment.study.study import Study, variants

RATE_SESSIONS = 20
"""The current rate is estimated from at most this many of the last finished sessions, ..."""
MIN_RATE_SESSIONS = 3
"""... from at least this many, ..."""
RATE_WINDOW = 86_400.0
"""... all of them finished within this many seconds."""


@dataclass(frozen=True)
class ScenarioProgress:
    """Row of the progress table.

    Attributes
    ----------
    scenario
        Scenario, or ``All``.
    wanted
        Number of complete sessions wanted.
    states
        Number of sessions in each of `STATES`.
    counted
        Number of finished sessions that count towards ``wanted``: the plausible ones.
    flagged
        Number of flagged finished sessions; None while unknown.
    done_at
        Expected completion time at the current rate (Unix time); None if it cannot be estimated.
    """

    scenario: str
    wanted: int
    states: Mapping[str, int]
    counted: int
    flagged: int | None
    done_at: float | None

    @property
    def percent(self) -> float:
        """Counted sessions in percent of the wanted ones, at most 100."""
        return min(100.0, 100.0 * self.counted / self.wanted) if self.wanted else 0.0


@dataclass(frozen=True)
class FunnelStage:
    """Row of the drop-out funnel: sessions that reached a stage, are in it, or ended in it.

    ``percent`` is the percentage of sessions that reached the stage.
    """

    name: str
    reached: int
    percent: float
    going: int
    left: int
    withdrawn: int


@dataclass(frozen=True)
class ScenarioPerformance:
    """Accuracy and response times in a scenario, of people who answered all test trials.

    ``accuracy`` is the mean over people, ``margin`` half the width of its 95 % confidence interval
    (normal approximation). Values are None if there are too few people.
    """

    scenario: str
    people: int
    accuracy: float | None
    margin: float | None
    accuracies: Histogram
    median_rt_ms: float | None
    times: Histogram


@dataclass(frozen=True)
class DisplayCounts:
    """Counts of trials by how their movie was displayed; see `summaries.AnswerCounts`."""

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
    def percent(self) -> float | None:
        """Trials with all frames in percent of those whose number of frames is known."""
        known = self.trials - self.unknown
        return 100.0 * self.full / known if known else None


@dataclass(frozen=True)
class ConditionCounts:
    """Row of the table of conditions: sessions by state, flagged ones, and mean accuracy.

    ``counted``, ``flagged`` and ``accuracy`` are as in `ScenarioProgress` and
    `ScenarioPerformance`, the latter of finished sessions that count.
    """

    name: str
    states: Mapping[str, int]
    counted: int
    flagged: int | None
    accuracy: float | None


@dataclass(frozen=True)
class Overview:
    """Content of the overview page, for sessions of one kind."""

    kind: str
    sessions: int
    kinds: Mapping[str, int]
    progress: tuple[ScenarioProgress, ...]
    total: ScenarioProgress
    funnel: tuple[FunnelStage, ...]
    performance: tuple[ScenarioPerformance, ...]
    shown: DisplayCounts
    browsers: tuple[DisplayCounts, ...]
    refresh_rates: tuple[DisplayCounts, ...]
    rules: tuple[tuple[str, tuple[int, ...]], ...]
    conditions: tuple[ConditionCounts, ...]


def compute_overview(
    study: Study, summaries: Sequence[SessionSummary], flags: Flags, now: float, kind: str
) -> Overview:
    """Compute the overview of the sessions of one kind.

    Parameters
    ----------
    study
        The study.
    summaries
        Summaries of all sessions.
    flags
        Flags of the sessions of this kind.
    now
        Current Unix time, for the expected completion.
    kind
        ``person``, ``simulated`` or ``preview``.
    """
    chosen = [summary for summary in summaries if summary.facts["kind"] == kind]
    by_scenario = {
        name: [s for s in chosen if s.facts["scenario"] == name] for name in study.offered
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
        funnel(chosen, stages_shown(study)),
        tuple(_performance(study, name, part) for name, part in by_scenario.items()),
        _display_counts("All", chosen),
        _grouped(chosen, lambda s: browser_label(str(s.facts["device"].get("user_agent", "")))),
        _grouped(chosen, lambda s: refresh_rate_label(s.facts["device"].get("refresh_hz"))),
        _rules(list(by_scenario.values()), flags),
        _conditions(study, chosen, flags),
    )


def _progress(
    name: str, wanted: int, part: Sequence[SessionSummary], flags: Flags, now: float
) -> ScenarioProgress:
    """Return the row of the progress table for one scenario."""
    states = Counter(summary.state for summary in part)
    counts = {state: states[state] for state in STATES}
    counted = [s for s in part if s.state == "finished" and s.facts["implausible"] is None]
    finished = [float(s.facts["finished_at"]) for s in counted]
    end = expected_end(finished, wanted, now)
    return ScenarioProgress(name, wanted, counts, len(counted), _flagged(part, flags), end)


def _conditions(
    study: Study, part: Sequence[SessionSummary], flags: Flags
) -> tuple[ConditionCounts, ...]:
    """Return the rows of the table of conditions, in the order of the study."""
    rows = []
    for condition in study.conditions:
        own = [s for s in part if s.facts["condition"] == condition.name]
        states = Counter(summary.state for summary in own)
        done = [s for s in own if s.state == "finished" and s.facts["implausible"] is None]
        accuracies = [s.answered.accuracy for s in done if s.answered.accuracy is not None]
        rows.append(
            ConditionCounts(
                condition.name,
                {state: states[state] for state in STATES},
                len(done),
                _flagged(own, flags),
                fmean(accuracies) if accuracies else None,
            )
        )
    return tuple(rows)


def _total(
    rows: Sequence[ScenarioProgress], part: Sequence[SessionSummary], flags: Flags
) -> ScenarioProgress:
    """Return the total row; its completion time is the latest one, if all can be estimated."""
    counts = {state: sum(row.states[state] for row in rows) for state in STATES}
    open_rows = [row for row in rows if row.counted < row.wanted]
    ends = [row.done_at for row in open_rows]
    known = [end for end in ends if end is not None]
    done_at = max(known) if known and len(known) == len(ends) else None
    return ScenarioProgress(
        "All",
        sum(row.wanted for row in rows),
        counts,
        sum(row.counted for row in rows),
        _flagged(part, flags),
        done_at,
    )


def _flagged(part: Sequence[SessionSummary], flags: Flags) -> int | None:
    """Count the flagged finished sessions; None if the flags are not known."""
    if not flags.are_known:
        return None
    return sum(s.state == "finished" and bool(flags.of(s.facts["session"])) for s in part)


def expected_end(finished: Sequence[float], wanted: int, now: float) -> float | None:
    """Estimate when ``wanted`` sessions will have finished, from the current rate.

    The rate is that of the last `RATE_SESSIONS` sessions. It includes the time since the last
    one, so it decreases while nobody finishes. With n recent sessions, the first at time t, the
    result is ``now + missing * (now - t) / (n - 1)``.

    Parameters
    ----------
    finished
        Times at which sessions finished (Unix time, seconds).
    wanted
        Number of sessions wanted.
    now
        Current time.

    Returns
    -------
    float or None
        The expected time; None if enough have finished, or too few recently.
    """
    missing = wanted - len(finished)
    recent = sorted(t for t in finished if now - t <= RATE_WINDOW)[-RATE_SESSIONS:]
    if missing <= 0 or len(recent) < MIN_RATE_SESSIONS or now <= recent[0]:
        return None
    return now + missing * (now - recent[0]) / (len(recent) - 1)


def funnel(part: Sequence[SessionSummary], order: Sequence[str]) -> tuple[FunnelStage, ...]:
    """Count for each stage the sessions that reached it, are in it, or ended in it."""
    at = {stage: Counter(s.state for s in part if s.stage == stage) for stage in order}
    steps = []
    for index, stage in enumerate(order):
        reached = sum(at[later].total() for later in order[index:])
        percent = 100.0 * reached / len(part) if part else 0.0
        states = at[stage]
        ended = sum(states[name] for name in ("withdrawn", "declined", "screened_out", "void"))
        steps.append(
            FunnelStage(label(stage), reached, percent, states["going"], states["left"], ended)
        )
    return tuple(steps)


def _performance(study: Study, name: str, part: Sequence[SessionSummary]) -> ScenarioPerformance:
    """Return accuracy and response times of the people who completed one scenario."""
    # The same in all orders; conditions may have fewer blocks.
    offering = [each for each in variants(study) if name in each.offered] or [study]
    trials = min(session_trials(each, name, 0)["test"] for each in offering)
    counted = [s for s in part if s.state != "void"]
    complete = [s.answered for s in counted if trials and s.answered.test >= trials]
    accuracies = [answered.correct / answered.test for answered in complete]
    times = list(chain.from_iterable(answered.rt_ms for answered in complete))
    margin = 1.96 * stdev(accuracies) / math.sqrt(len(accuracies)) if len(accuracies) > 1 else None
    return ScenarioPerformance(
        name,
        len(complete),
        fmean(accuracies) if accuracies else None,
        margin,
        accuracy_histogram(accuracies),
        median(times) if times else None,
        rt_histogram(times),
    )


def _display_counts(name: str, part: Sequence[SessionSummary]) -> DisplayCounts:
    """Sum the display counts of the sessions that have answers."""
    counts = [summary.answered for summary in part if summary.answered.trials]
    fields = ("trials", "full", "short", "over", "unknown", "dropped", "hidden")
    return DisplayCounts(
        name, len(counts), *(sum(getattr(c, field) for c in counts) for field in fields)
    )


def _grouped(
    part: Sequence[SessionSummary], label: Callable[[SessionSummary], str]
) -> tuple[DisplayCounts, ...]:
    """Sum the display counts by the label of each session, most trials first."""
    groups: dict[str, list[SessionSummary]] = {}
    for summary in part:
        if summary.answered.trials:
            groups.setdefault(label(summary), []).append(summary)
    rows = [_display_counts(name, members) for name, members in groups.items()]
    return tuple(sorted(rows, key=lambda row: -row.trials))


def _rules(
    parts: Sequence[Sequence[SessionSummary]], flags: Flags
) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Count for each rule the finished sessions that it flags, by scenario."""
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
    # It calls itself Safari, of a version that is neither Safari's nor its own.
    ("WebKitGTK", r"\(X11; [^)]*\) .* Version/\S+ Safari/"),
    ("Safari", r"Version/(\d+)\S* (?:Mobile/\S+ )?Safari/"),
)


def browser_label(user_agent: str) -> str:
    """Return name and major version of a browser, such as ``Firefox 140``, or ``other``.

    WebKitGTK does not tell its version.
    """
    for name, pattern in _BROWSERS:
        match = re.search(pattern, user_agent[:1000])
        if match:
            return " ".join((name, *match.groups()))
    return "other" if user_agent else "browser not known"


def refresh_rate_label(refresh_hz: object) -> str:
    """Return the common refresh rate within 3 % of the measured one, else round to 5 Hz."""
    if not isinstance(refresh_hz, int | float) or not refresh_hz > 0:
        return "screen not known"
    for usual in (30, 50, 60, 75, 90, 100, 120, 144, 165, 240):
        if abs(refresh_hz - usual) <= 0.03 * usual:
            return f"{usual} Hz"
    return f"about {5 * round(refresh_hz / 5)} Hz"
