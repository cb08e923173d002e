"""Page of the leaderboard: ranked models, what is not ranked, scores by scenario, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import pandas as pd

from physion.analysis.leaderboard.leaderboard import Leaderboard
from physion.analysis.metrics import Metric, leaderboard_metrics
from physion.analysis.tables.stimuli import in_order
from physion.report.page.blocks import (
    definition_list,
    details,
    interval,
    paragraph,
    percent,
    table,
    undefined,
)
from physion.report.page.document import Section, render_document
from physion.report.words import number, plural

GROUPS = {
    "model": "Models that predict",
    "detection": "Readout full: sees the whole movie, not ranked",
    "people": "People",
    "anchor": "Anchors: what a score is worth",
}
"""Headings of the groups of rows by ``kind``, in their order."""


def leaderboard_page(
    board: Leaderboard, sorted_by: str = "accuracy", title: str = "Leaderboard"
) -> str:
    """Return the page as text.

    Parameters
    ----------
    board
        From `leaderboard.leaderboard`.
    sorted_by
        Column that decided the ranks; its scores are also shown by scenario.
    title
        Heading of the page.
    """
    rows = pd.concat([part for part in (board.table, board.anchors) if len(part)])
    count = plural(int((board.table["kind"] == "model").sum()), "model")
    lead = (
        f'<p class="lead">{escape(count)}, ranked by {escape(sorted_by)}; '
        "95 % intervals in small print.</p>"
    )
    sections = [
        Section("Ranks", _ranks(rows)),
        Section("By scenario", _by_scenario(board, sorted_by)),
        Section("Files", _files(board)),
        Section("Settings", definition_list(board.settings) + _definitions()),
    ]
    return render_document(title, lead, sections, board.mark)


def _metrics(rows: pd.DataFrame) -> list[Metric]:
    """Return the metrics that are known of any row; one kappa is enough."""
    shown = [one for one in leaderboard_metrics() if rows[one.name].notna().any()]
    single = any(one.name == "kappa" for one in shown)
    return [one for one in shown if not (single and one.name == "kappa_from_averages")]


def _ranks(rows: pd.DataFrame) -> str:
    """Return one table: the ranked models, then the other groups under their headings."""
    metrics = _metrics(rows)
    trained = bool(rows["training"].fillna("").ne("").any())
    header = ["model", "rank", "first", "readout", *(["training"] if trained else []), "stimuli"]
    header += [one.label for one in metrics[:1]]
    header += ["r of its ceiling", "kappa of people's"]
    header += [one.label for one in metrics[1:]]
    groups = [
        (heading, [_line(row, metrics, trained) for row in own.to_dict("records")])
        for kind, heading in GROUPS.items()
        if len(own := rows[rows["kind"] == kind])
    ]
    return table(header, [], groups=groups) + _reasons(rows)


def _line(row: Mapping[str, Any], metrics: Sequence[Metric], trained: bool) -> list[str]:
    whole = row["stimuli"] == row["of_stimuli"]
    counts = f"{row['stimuli']}" if whole else f"{row['stimuli']} of {row['of_stimuli']}"
    series = pd.Series(row)
    scores = [interval(series, one.name) if pd.notna(row[one.name]) else "" for one in metrics]
    relative = [number(row[name]) if pd.notna(row[name]) else ""
                for name in ("r_of_ceiling", "kappa_of_people")]  # fmt: skip
    return [
        escape(str(row["model"])),
        _rank(row),
        percent(float(row["first"])).replace(" ", "\u00a0") if pd.notna(row["first"]) else "",
        escape(_text(row["readout"])),
        *([escape(_text(row["training"]))] if trained else []),
        counts,
        *scores[:1],
        *relative,
        *scores[1:],
    ]


def _text(value: object) -> str:
    return "" if pd.isna(value) else str(value)  # type: ignore[call-overload]


def _rank(row: Mapping[str, Any]) -> str:
    if pd.isna(row["rank"]):
        return ""
    if pd.isna(row["rank_low"]):
        return str(int(row["rank"]))
    bounds = f"{int(row['rank_low'])} to {int(row['rank_high'])}"
    return f"{int(row['rank'])} <small>{bounds}</small>"


def _reasons(rows: pd.DataFrame) -> str:
    items = [
        f"<li>{escape(str(row['model']))}: {escape(row['reason'])}</li>"
        for row in rows.to_dict("records")
        if row["reason"]
    ]
    return f'<ul class="notes">{"".join(items)}</ul>' if items else ""


def _by_scenario(board: Leaderboard, key: str) -> str:
    """Return the scores of the column by model and scenario; accuracy if it has none."""
    rows = board.by_scenario
    name = key if f"{key}_low" in rows else "accuracy"
    label = {one.name: one.label for one in leaderboard_metrics()}[name]
    scenarios = in_order(rows["scenario"])
    known = set(zip(board.table["file"], board.table["agent"], strict=True))
    lines: dict[bool, list[list[str]]] = {True: [], False: []}
    for (file, agent), own in rows.groupby(["file", "agent"], sort=False):
        if file and (file, agent) not in known:
            continue
        by_name = own.set_index("scenario").assign(reason="undefined")
        if by_name[name].isna().all():
            continue
        cells = [
            interval(by_name.loc[scenario], name)
            if scenario in by_name.index
            else undefined("no predictions")
            for scenario in scenarios
        ]
        lines[bool(file)].append([escape(str(agent)), *cells])
    header = ["", *scenarios]
    return table(header, lines[True], label, (GROUPS["anchor"], lines[False]))


def _files(board: Leaderboard) -> str:
    header = ["model", "file", "SHA-256", "versions", "licence"]
    lines = [
        [
            escape(str(row["agent"])),
            f"<code>{escape(str(row['file']))}</code>",
            f'<code title="{escape(str(row["sha256"]))}">{escape(str(row["sha256"])[:12])}</code>',
            escape(_text(row["versions"])) or "not stated",
            escape(_text(row["license"])) or "not stated",
        ]
        for row in board.table.to_dict("records")
    ]
    parts = [table(header, lines)]
    if len(board.refused):
        cells = [[escape(str(row["file"])), escape(str(row["reason"]))]
                 for row in board.refused.to_dict("records")]  # fmt: skip
        parts.append(table(["file", "not compared because"], cells))
    left_out = board.dropped.groupby(["file", "agent", "reason"], sort=False)["stimuli"].sum()
    if len(left_out):
        cells = [[escape(str(agent) or "people"), escape(str(file)), escape(str(reason)), str(n)]
                 for (file, agent, reason), n in left_out.items()]  # fmt: skip
        parts.append(
            details("What was left out", table(["whose", "file", "reason", "stimuli"], cells))
        )
    return "".join(parts) + "".join(paragraph(text) for text in board.warnings)


def _definitions() -> str:
    meaning = {one.label: one.definition for one in leaderboard_metrics()}
    return f"<h3>What the numbers mean</h3>{definition_list(meaning)}"
