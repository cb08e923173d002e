"""Parts of the page about sessions: which were flagged, and the effect of excluding them."""

from __future__ import annotations

from html import escape

import pandas as pd

from physion.analysis.models.anchors import TWO_PEOPLE
from physion.analysis.people.exclusions import RULES, ExclusionRules, streak_limit
from physion.analysis.people.results import PeopleResults
from physion.analysis.tables.stimuli import MEAN, in_order
from physion.report.inputs import ReportInputs
from physion.report.page.blocks import (
    ANCHORS,
    PageColumn,
    paragraph,
    rows_table,
    table,
    undefined,
)


def sessions(inputs: ReportInputs) -> str:
    """Return which sessions were flagged, by which rule, and the effect of flagged sessions."""
    if inputs.people is None:
        return ""
    return sessions_alone(inputs.people, _models_with_and_without(inputs))


def sessions_alone(people: PeopleResults, models: str = "") -> str:
    """Return the same without models; ``models``: their scores without and with these sessions."""
    result = people.tables
    parts = [paragraph(describe_rules(people.rules))]
    if people.confirmed:
        parts.append(paragraph(f"Rules {people.confirmed}."))
    parts.append(_flag_counts(result["flag_counts"]))
    parts.append(_with_and_without(people) + models)
    if len(result["flag_effects"]):
        columns = [
            PageColumn("rule", "term", "text"),
            PageColumn("log odds of being right", "b", "interval", 3, "low", "high"),
            PageColumn("t", "t"),
            PageColumn("p", "p", "p"),
            PageColumn("answers", "rows", "count"),
            PageColumn("participants", "clusters", "count"),
        ]
        words = (
            "Effect of a flag on being right, over all sessions: logistic regression with an "
            "intercept for each scenario, standard errors clustered by participant. Low accuracy "
            "is itself a reason to be flagged, so its effect, and that of “flagged”, is there by "
            "construction"
        )
        parts.append(rows_table(result["flag_effects"], columns, words))
    return "\n".join(parts)


def _flag_counts(counts: pd.DataFrame) -> str:
    rules = list(dict.fromkeys(counts["rule"]))
    rules = [name for name in rules if name not in ("flagged", "kept", "all")]
    rules += ["flagged", "kept", "all"]
    wide = counts.pivot(index="scenario", columns="rule", values="sessions").fillna(0)
    names = in_order(counts["scenario"])
    rows = [[escape(name), *(str(int(wide.loc[name, rule])) for rule in rules)] for name in names]
    rows.append(["all", *(str(int(wide[rule].sum())) for rule in rules)])
    heads = [name.replace("_", " ") for name in rules]
    words = "Sessions that each rule flags; one session can be flagged by several rules"
    return table(["scenario", *heads], rows, words)


def _with_and_without(people: PeopleResults) -> str:
    """Return people's accuracy without and with the flagged sessions."""
    rows = people.tables["with_and_without"]
    columns = [
        PageColumn("people", "people", "count"),
        PageColumn("accuracy", "accuracy", "interval", 3),
    ]
    cells = []
    for name in dict.fromkeys(rows["scenario"]):
        line = [escape(str(name))]
        for which in ("unflagged", "complete"):
            subset = rows[(rows["scenario"] == name) & (rows["sessions"] == which)]
            line += (
                [c.cell(subset.iloc[0]) for c in columns]
                if len(subset)
                else [undefined("none"), ""]
            )
        cells.append(line)
    header = ["scenario", "people, unflagged", "accuracy", "people, all complete", "accuracy"]
    return table(header, cells, "Accuracy of people without flagged sessions and with them")


def _models_with_and_without(inputs: ReportInputs) -> str:
    """Return the models' scores without and with the flagged sessions."""
    if inputs.comparison_all is None:
        return ""
    with_all = inputs.comparison_all.all_scores
    grouped: dict[str, list[list[str]]] = {"model": [], "anchor": []}
    for _, row in inputs.comparison.all_scores.iterrows():
        if row["scenario"] != MEAN or row["agent"] == TWO_PEOPLE:
            continue
        other = with_all[(with_all["agent"] == row["agent"]) & (with_all["scenario"] == MEAN)]
        line = [escape(str(row["agent"]))]
        for key in ("difference", "r"):
            column = PageColumn("", key, "interval")
            line += [column.cell(subset) for subset in (row, other.iloc[0])]
        grouped[row["kind"]].append(line)
    header = [
        "model",
        "less people, unflagged",
        "with all complete",
        "r, unflagged",
        "with all complete",
    ]
    return table(
        header,
        grouped["model"],
        "Models, mean over scenarios: accuracy less people's, and r",
        (ANCHORS, grouped["anchor"]),
    )


def describe_rules(rules: ExclusionRules) -> str:
    """Describe the rules of a set with their thresholds."""
    words = []
    if rules.streak_percentile is not None:
        limits = ", ".join(
            f"{streak_limit(n, rules.streak_percentile)} for {n} trials" for n in (150, 60)
        )
        words.append(
            "a streak of one answer longer than in "
            f"{rules.streak_percentile:g} % of as many fair coin tosses (over {limits})"
        )
    if rules.alternation is not None:
        words.append(f"{rules.alternation} or more alternating answers in a row")
    if rules.familiarization_share is not None:
        words.append(f"{rules.familiarization_share:.0%} or fewer of the practice trials right")
    if rules.accuracy_sd is not None:
        words.append(f"accuracy {rules.accuracy_sd:g} sd below the {rules.accuracy_centre}")
    if rules.rt_sd is not None:
        words.append(f"{rules.rt_summary} log response time {rules.rt_sd:g} sd above the median")
    return (
        f"Rules “{rules.name}”: {'; '.join(words)}; not all trials answered; not the participant's "
        "first session. Rules flag; the main analysis leaves flagged sessions out, and the tables "
        "below say what changes with them. Centres and standard deviations are those of the "
        f"scenario's complete sessions (sd with {'n − 1' if rules.ddof else 'n'})."
    )


def dropped(result: PeopleResults) -> str:
    """Return counts of excluded answers, by step and reason."""
    rows = result.tables["left_out"]
    if rows.empty:
        return paragraph("Nothing.")
    keys = ["step", "reason"]
    totals = rows.groupby(keys, sort=False)[["sessions", "rows"]].sum().reset_index()
    columns = [
        PageColumn("step", "step", "text"),
        PageColumn("reason", "reason", "text"),
        PageColumn("sessions", "sessions", "count"),
        PageColumn("answers", "rows", "count"),
    ]
    cells = [[column.cell(row) for column in columns] for _, row in totals.iterrows()]
    return table([column.heading for column in columns], cells)


def methods(inputs: ReportInputs) -> dict[str, str]:
    """Return the settings about participant-level answers, as text."""
    return {} if inputs.people is None else rules_text(inputs.people)


def rules_text(people: PeopleResults) -> dict[str, str]:
    """Return the exclusion rules as text."""
    words = {
        "Exclusions": describe_rules(people.rules),
        "Rules applied": ", ".join(name.replace("_", " ") for name in RULES),
    }
    return words | ({"Rules confirmed": people.confirmed} if people.confirmed else {})
