"""Drift diffusion model of each session: drift, boundary and nondecision time from --responses.

Flagged sessions are left out. About a second a session. Needs the extra diffusion.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from physion.analysis.people.participants import Responses

ESTIMATES = ("accuracy", "drift", "boundary", "nondecision_s")


@dataclass(frozen=True)
class Options:
    """Answers of single participants."""

    responses: tuple[Path, ...] = ()
    """Answers of single participants: our export or the study's raw files."""
    sessions: Path | None = None
    """Table of sessions of our export."""
    rules: str = "preregistered"
    """Exclusion rules: preregistered or official-code."""
    expected: Path | None = None
    """Table of the stimuli (stimulus) that each session, or each scenario, must have; if not given,
    expected.csv beside the responses, else those that half of the scenario's sessions answered."""
    accept_rules: tuple[str, ...] = ()
    """Exclusion rules that may leave out more than a third of a scenario's sessions."""
    simulated: bool = False
    """Rehearse with the simulated participants of --responses alone; the table is marked."""
    out: Path | None = None
    """CSV file for the estimates of every session."""
    json: bool = False
    """Print one JSON list, an object a session."""


def main(options: Options) -> int:
    """Fit every session; print means by scenario."""
    from physion.analysis.people.participants import REHEARSAL
    from physion.analysis.statistics.diffusion import diffusion_by_session
    from physion.cli.output import console, print_warnings
    from physion.cli.text_table import text_table

    kept = _unflagged(options)
    if kept.simulated_sessions:
        print_warnings([REHEARSAL])
    table = diffusion_by_session(kept.test)
    if options.out is not None:
        from physion.report.write import write_csv

        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_csv(options.out, table, bool(kept.simulated_sessions))
    if options.json:
        print(table.to_json(orient="records", double_precision=15))
        return 0
    console.print(text_table(_by_scenario(table), "Means over sessions (sd)"), markup=False)
    without = table[table["reason"] != ""]
    for reason, count in without["reason"].value_counts().items():
        console.print(f"{count} of {len(table)} sessions: {reason}", markup=False, soft_wrap=True)
    return 0


def _unflagged(options: Options) -> Responses:
    """Read the responses and leave out flagged sessions."""
    from physion.analysis.people.completeness import (
        check_expected,
        drop_unexpected,
        find_expected,
        read_expected,
    )
    from physion.analysis.people.exclusions import check_excluded, flag_sessions, without_flagged
    from physion.analysis.people.results import read_any_responses, rules_called
    from physion.core.errors import BadInputError

    if not options.responses:
        raise BadInputError("give the answers of people: --responses FILE")
    responses = read_any_responses(
        options.responses, options.sessions, "simulated" if options.simulated else "people"
    )
    file = options.expected or find_expected(options.responses)
    expected = None if file is None else read_expected(file)
    check_expected(responses, expected)
    flags = flag_sessions(responses, rules_called(options.rules), expected=expected)
    check_excluded(flags, options.accept_rules)
    return without_flagged(drop_unexpected(responses, expected).drop_void(), flags)


def _by_scenario(table: pd.DataFrame) -> pd.DataFrame:
    """Return means and standard deviations over the sessions with good estimates, as text."""
    import pandas as pd

    rows = []
    for scenario, own in table[table["reason"] == ""].groupby("scenario", sort=False):
        row = {"scenario": scenario, "sessions": str(len(own))}
        for name in ESTIMATES:
            sd = f" ({own[name].std():.2f})" if len(own) > 1 else ""
            row[name] = f"{own[name].mean():.2f}{sd}"
        rows.append(row)
    return pd.DataFrame(rows, columns=["scenario", "sessions", *ESTIMATES])
