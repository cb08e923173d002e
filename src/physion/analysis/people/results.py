"""Results of all analyses of people, computed once for tables, figures and page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from physion.analysis.intervals import Bootstrap
from physion.analysis.people.effects import (
    accuracy_by_background,
    background,
    regress_attributes,
    regress_hypotheses,
    side_bias,
    with_attributes,
    yes_bias,
)
from physion.analysis.people.exclusions import (
    PREREGISTERED,
    RULE_SETS,
    ExclusionRules,
    Expected,
    check_expected,
    completeness_warnings,
    count_flags,
    drop_unexpected,
    flag_sessions,
    large_exclusions,
    whole_sessions,
    with_and_without,
    without_flagged,
)
from physion.analysis.people.measures import (
    accuracy_by_condition,
    accuracy_by_participant,
    accuracy_by_scenario,
    accuracy_by_stimulus,
    agreement_by_scenario,
    item_statistics,
)
from physion.analysis.people.responses import (
    REHEARSAL,
    Participants,
    Responses,
    missing_times,
    pooling_warnings,
    read_official_responses,
    read_responses,
    with_own_questions,
)
from physion.analysis.tables import (
    ATTRIBUTES,
    attribute_names,
    attributes_from_names,
    attributes_from_table,
    better_attributes,
)
from physion.analysis.tables import COLUMNS as ATTRIBUTE_COLUMNS
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import read_plain
from physion.core.names import scenario_of
from physion.core.settings import parse_json
from physion.core.tables import read_csv, read_table

_MAX_BYTES = 100_000_000


@dataclass(frozen=True)
class PeopleResults:
    """Results about the people of a study.

    ``kept``: the responses of the main analysis, without flagged sessions and excluded stimuli;
    ``whole``: the responses of all complete first sessions; ``rules``: the exclusion rules;
    ``tables``: by name, with the columns of the function in parentheses:

    - ``flags`` (`flag_sessions`), ``flag_counts``;
    - ``with_and_without``: `accuracy_by_scenario` without and with flagged sessions;
    - ``participants``, ``by_scenario``, ``by_condition``, ``by_stimulus``
      (`people.accuracy_by_...`), ``items`` (`item_statistics`);
    - ``agreement``: agreement among people (`agreement_by_scenario`);
    - ``yes_bias``, ``side_bias``, ``background``, ``background_tests``;
    - ``attributes`` of the stimuli that people answered, ``hypotheses`` (`regress_hypotheses`) and
      ``attribute_effects`` (`regress_attributes`);
    - ``left_out``: dropped answers, with their reasons.

    ``warnings``: what may make the results wrong, one sentence each; ``stimuli``: names of all
    stimuli of the responses, also of excluded ones.
    """

    kept: Responses
    whole: Responses
    rules: ExclusionRules
    tables: dict[str, pd.DataFrame]
    warnings: tuple[str, ...] = ()
    stimuli: frozenset[str] = frozenset()

    @property
    def mark(self) -> str:
        """What must stand at the top of every page: `REHEARSAL` for simulated participants."""
        return REHEARSAL if self.whole.simulated_sessions else ""

    def labels(self) -> dict[str, bool]:
        """Return the outcome of every stimulus that people answered."""
        rows = self.whole.test.drop_duplicates("stimulus")
        return {str(s): bool(v) for s, v in zip(rows["stimulus"], rows["label"], strict=True)}

    def zone(self) -> pd.DataFrame:
        """Return the middle 95 % of participants, and the interval of their mean, by scenario.

        Columns as in `read_human_zone`, with a row for the mean over scenarios.
        """
        columns = ["scenario", "zone_low", "zone_high", "accuracy_low", "accuracy_high"]
        names = ["scenario", "low", "high", "bootstrap_low", "bootstrap_high"]
        return self.tables["by_scenario"][columns].set_axis(names, axis=1)


def read_any_responses(
    files: Sequence[Path], sessions: Path | None = None, participants: Participants = "people"
) -> Responses:
    """Read the export of our experiment (one file), or raw files of the original study.

    Answers to the lab's own questions are read from `responses.QUESTIONS_FILE` next to it.
    The study's files are recognised by their column ``gameID``; all of their participants are
    people. ``participants``: whose sessions to keep. Raises `BadInputError`.
    """
    official = [p for p in files if p.suffix.lower() != ".parquet" and "gameID" in read_csv(p, ())]
    if official and len(official) < len(files):
        raise BadInputError(f"{official[0]} has the study's raw columns and the other files do not")
    if official:
        if participants == "simulated":
            raise BadInputError("the study's raw files hold only people: leave out --simulated")
        if sessions is not None:
            raise BadInputError("the study's raw files hold their sessions; give no table of them")
        return read_official_responses(files)
    if len(files) != 1:
        raise BadInputError("give one file of responses, or raw files of the original study")
    return with_own_questions(
        read_responses(files[0], sessions, participants=participants), files[0]
    )


STUDY_FILE = "study.json"
"""File with the versions of a study, in the folder of its exported responses."""


def rules_called(name: str | None, responses: Sequence[Path] = ()) -> ExclusionRules:
    """Return the rules of this name; raise `UnknownNameError` with the closest ones.

    None: the rules of the study whose export the responses are, else `PREREGISTERED`.
    """
    if name is None:
        name = _rules_of_study(responses) or PREREGISTERED.name
    if name not in RULE_SETS:
        raise UnknownNameError("set of exclusion rules", name, RULE_SETS)
    return RULE_SETS[name]


def _rules_of_study(responses: Sequence[Path]) -> str | None:
    """Return the rules in the latest settings of an exported study; None without the file."""
    path = next(
        (p.parent / STUDY_FILE for p in responses if (p.parent / STUDY_FILE).exists()), None
    )
    if path is None:
        return None
    content = parse_json(read_plain(path, _MAX_BYTES).decode(errors="replace"), str(path))
    states = content.get("states") if isinstance(content, dict) else None
    latest = states[-1] if isinstance(states, list) and states else {}
    settings = latest.get("settings") if isinstance(latest, dict) else None
    return settings.get("exclusions") if isinstance(settings, dict) else None


def read_attributes(path: Path) -> pd.DataFrame:
    """Read the attributes of one's own stimuli: a table (CSV or parquet), or a dataset or its
    index; see `attributes_from_table`.
    """
    file = path / "index.parquet" if path.is_dir() else path
    return attributes_from_table(read_table(file), str(file))


def analyse_people(
    responses: Responses,
    *,
    rules: ExclusionRules = PREREGISTERED,
    expected: Expected | None = None,
    attributes: pd.DataFrame | None = None,
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    bootstrap: Bootstrap | None = None,
) -> PeopleResults:
    """Flag sessions, exclude stimuli, then run every analysis of people.

    Parameters
    ----------
    responses
        Answers of participants.
    rules
        Exclusion rules.
    expected
        Test stimuli that a session must have, by scenario; by default those that at least half of
        the scenario's sessions answered. Answers to other stimuli are dropped.
    attributes
        Attributes of one's own stimuli, from `attributes_from_table`; attributes of other stimuli
        come from official names.
    exclude, exclude_ledge
        Stimuli to exclude, and whether to exclude Roll's ledges.
    bootstrap
        Draws for the intervals.

    Raises
    ------
    BadInputError
        If no session remains, or ``expected`` names none.
    """
    draws = bootstrap or Bootstrap()
    check_expected(responses, expected)
    flags = flag_sessions(responses, rules, expected=expected)
    shown = drop_unexpected(responses, expected).drop_void()
    shown = shown.drop_stimuli(exclude, exclude_ledge)
    kept = without_flagged(shown, flags)
    whole = shown.keep_sessions(
        set(flags.loc[whole_sessions(flags), "session"]), "session is incomplete or repeated"
    )
    tables = {"flags": flags, "flag_counts": count_flags(flags)}
    tables["with_and_without"] = with_and_without(
        shown, flags, lambda some: accuracy_by_scenario(some.test, draws)
    )
    tables["participants"] = accuracy_by_participant(kept.test)
    tables["by_scenario"] = accuracy_by_scenario(kept.test, draws)
    tables["by_condition"] = accuracy_by_condition(kept.test, draws)
    tables["by_stimulus"] = accuracy_by_stimulus(kept.test, draws)
    tables["items"] = item_statistics(kept.test)
    tables["agreement"] = agreement_by_scenario(kept.test, draws)
    tables["yes_bias"] = yes_bias(kept.test, draws)
    tables["side_bias"] = side_bias(kept.test, draws)
    tables["background"] = background(kept.sessions, kept.own)
    tables["background_tests"] = accuracy_by_background(kept.test, kept.sessions, kept.own)
    tables["attributes"] = _attributes(tables["by_stimulus"]["stimulus"], attributes)
    stimuli_with_attributes = with_attributes(tables["by_stimulus"], tables["attributes"])
    tables["hypotheses"] = regress_hypotheses(stimuli_with_attributes)
    tables["attribute_effects"] = regress_attributes(
        stimuli_with_attributes, attribute_names(tables["attributes"])
    )
    tables["left_out"] = pd.concat([kept.dropped, missing_times(kept)], ignore_index=True)
    mark = (REHEARSAL,) if responses.simulated_sessions else ()
    warnings = (
        *mark, *completeness_warnings(responses, expected), *large_exclusions(flags),
        *pooling_warnings(kept.test),
    )  # fmt: skip
    stimuli = frozenset(responses.trials["stimulus"])
    return PeopleResults(kept, whole, rules, tables, warnings, stimuli)


def _attributes(stimuli: pd.Series, given: pd.DataFrame | None) -> pd.DataFrame:
    """Return the attributes of ``stimuli``: those given, else those in official names."""
    named = [name for name in stimuli if scenario_of(name) is not None]
    by_name = (
        attributes_from_names(named) if named else pd.DataFrame(columns=list(ATTRIBUTE_COLUMNS))
    )
    result = by_name
    if given is not None:
        given_rows = given[given["stimulus"].isin(stimuli)]
        if given_rows.empty:
            raise BadInputError(
                f"the table of attributes names none of the stimuli that people answered: they "
                f"answered {stimuli.iloc[0]!r}, it has {given['stimulus'].iloc[0]!r}"
            )
        result = better_attributes(given_rows, by_name) if len(by_name) else given_rows
    # Counts in parquet may be nullable integers, which the regressions do not accept.
    return result.astype(dict.fromkeys(ATTRIBUTES, "float64")).reset_index(drop=True)
