"""All that the answers of single participants say, computed once for tables, figures and page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from physion.analysis import Bootstrap
from physion.analysis.attributes import COLUMNS as ATTRIBUTE_COLUMNS
from physion.analysis.attributes import attributes_from_names
from physion.analysis.biases import (
    accuracy_by_background,
    background,
    learning,
    side_bias,
    yes_bias,
)
from physion.analysis.csv_table import read_csv
from physion.analysis.exclusions import (
    PREREGISTERED,
    RULES,
    ExclusionRules,
    count_flags,
    flag_effect,
    flag_sessions,
    with_and_without,
)
from physion.analysis.hypotheses import regress_hypotheses, with_attributes
from physion.analysis.official_responses import read_official_responses
from physion.analysis.participants import Responses, read_responses
from physion.analysis.people import (
    accuracy_by_participant,
    accuracy_by_scenario,
    accuracy_by_stimulus,
    agreement_by_scenario,
)
from physion.analysis.stimuli import scenario_of
from physion.errors import BadInputError


@dataclass(frozen=True)
class PeopleResults:
    """The people of a study: who was flagged, and what the others answered.

    ``kept``: the responses of the main analysis, without flagged sessions and left-out stimuli;
    ``rules``: by which sessions were flagged; ``tables``: by name, each from the function of
    `physion.analysis` that bears its columns:

    - ``flags`` (`exclusions.flag_sessions`), ``flag_counts``, ``flag_effects``;
    - ``with_and_without``: `people.accuracy_by_scenario` without and with flagged sessions;
    - ``participants``, ``by_scenario``, ``by_stimulus`` (`people.accuracy_by_...`);
    - ``agreement``: how alike people are (`people.agreement_by_scenario`);
    - ``yes_bias``, ``side_bias``, ``learning``, ``background``, ``background_tests``;
    - ``hypotheses`` (`hypotheses.regress_hypotheses`);
    - ``left_out``: answers that were dropped, with their reasons.
    """

    kept: Responses
    whole: Responses
    rules: ExclusionRules
    tables: dict[str, pd.DataFrame]

    def labels(self) -> dict[str, bool]:
        """The outcome of every stimulus that people answered."""
        rows = self.whole.test.drop_duplicates("stimulus")
        return {str(s): bool(v) for s, v in zip(rows["stimulus"], rows["label"], strict=True)}

    def zone(self) -> pd.DataFrame:
        """The middle 95 % of participants by scenario, as `analysis.compare` takes it."""
        table = self.tables["by_scenario"]
        rows = table[table["zone_low"].notna()]
        return rows[["scenario", "zone_low", "zone_high"]].set_axis(
            ["scenario", "low", "high"], axis=1
        )


def read_any_responses(files: Sequence[Path], sessions: Path | None = None) -> Responses:
    """Responses of our experiment's export (one file), or raw files of the original study.

    The study's files are known by their column ``gameID``. Raises `BadInputError`.
    """
    official = [p for p in files if p.suffix.lower() != ".parquet" and "gameID" in read_csv(p, ())]
    if official and len(official) < len(files):
        raise BadInputError(f"{official[0]} has the study's raw columns and the other files do not")
    if official:
        if sessions is not None:
            raise BadInputError("the study's raw files hold their sessions; give no table of them")
        return read_official_responses(files)
    if len(files) != 1:
        raise BadInputError("give one file of responses, or raw files of the original study")
    return read_responses(files[0], sessions)


def analyse_people(
    responses: Responses,
    *,
    rules: ExclusionRules = PREREGISTERED,
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    bootstrap: Bootstrap | None = None,
) -> PeopleResults:
    """Flag sessions, leave out stimuli, then every analysis of people.

    Raises `BadInputError` where no session remains.
    """
    draws = bootstrap or Bootstrap()
    flags = flag_sessions(responses, rules)
    shown = responses.drop_stimuli(exclude, exclude_ledge)
    kept, whole = _sets(shown, flags)
    tables = {"flags": flags, "flag_counts": count_flags(flags)}
    tables["flag_effects"] = _flag_effects(shown, flags)
    tables["with_and_without"] = with_and_without(
        shown, flags, lambda some: accuracy_by_scenario(some.test, draws)
    )
    tables["participants"] = accuracy_by_participant(kept.test)
    tables["by_scenario"] = accuracy_by_scenario(kept.test, draws)
    tables["by_stimulus"] = accuracy_by_stimulus(kept.test, draws)
    tables["agreement"] = agreement_by_scenario(kept.test, draws)
    tables["yes_bias"] = yes_bias(kept.test, draws)
    tables["side_bias"] = side_bias(kept.test, draws)
    tables["learning"] = learning(kept.test)
    tables["background"] = background(kept.sessions)
    tables["background_tests"] = accuracy_by_background(kept.test, kept.sessions)
    tables["hypotheses"] = regress_hypotheses(
        with_attributes(tables["by_stimulus"], _attributes(tables["by_stimulus"]))
    )
    tables["left_out"] = kept.dropped
    return PeopleResults(kept, whole, rules, tables)


def _sets(shown: Responses, flags: pd.DataFrame) -> tuple[Responses, Responses]:
    """The responses without flagged sessions, and all complete first sessions."""
    whole = set(flags.loc[~flags["incomplete"] & ~flags["repeated"], "session"])
    unflagged = set(flags.loc[~flags["flagged"], "session"])
    if not unflagged:
        raise BadInputError(f"all {len(flags)} sessions are flagged: nothing is left to analyse")
    return (
        shown.keep_sessions(unflagged, "session is flagged"),
        shown.keep_sessions(whole, "session is incomplete or repeated"),
    )


def _flag_effects(responses: Responses, flags: pd.DataFrame) -> pd.DataFrame:
    asked = [rule for rule in (*RULES, "flagged") if 0 < flags[rule].sum() < len(flags)]
    parts = [flag_effect(responses, flags, rule) for rule in asked]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def attributes_by_name(people: PeopleResults) -> pd.DataFrame:
    """Elements, distractors and occluders of the stimuli that people answered."""
    return _attributes(people.tables["by_stimulus"])


def _attributes(by_stimulus: pd.DataFrame) -> pd.DataFrame:
    """The attributes as official names tell them; other stimuli have none."""
    named = [name for name in by_stimulus["stimulus"] if scenario_of(name) is not None]
    return attributes_from_names(named) if named else pd.DataFrame(columns=list(ATTRIBUTE_COLUMNS))
