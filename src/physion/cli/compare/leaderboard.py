"""One table of many prediction files: ranks, accuracy, r, kappa, RMSD, versions and licences.

Ranks have intervals over draws of people and stimuli. Models that see the whole movie (readout
full) are listed without a rank.

Exit code 1 where a file could not be compared; the others are in the table.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    import pandas as pd

    from physion.analysis.leaderboard.leaderboard import Leaderboard

SHOWN = ("rank", "ranks", "model", "readout", "training", "scenarios", "stimuli")
"""Columns on the console before the metrics, the versions and the file."""

NORMALISED = ("r_of_ceiling", "kappa_of_people")
"""Scores relative to what can be reached, after the metrics."""

GROUPS = {
    "model": "",
    "detection": "Readout full: sees the whole movie, not ranked",
    "people": "People",
    "anchor": "Anchors: what a score is worth",
}
"""Titles of the groups of rows by ``kind``."""


@dataclass(frozen=True)
class Options:
    """Prediction files, and the people to compare them with."""

    predictions: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Prediction files with the official column names."""
    humans: Path | None = None
    """Folder with human_accuracy-*.csv."""
    labels: Path | None = None
    """Official outcomes (stim_ID, label); if not given, looked for next to the folder of people."""
    responses: tuple[Path, ...] = ()
    """Answers of single participants, which give kappa: our export or the study's raw files."""
    sessions: Path | None = None
    """Table of sessions of our export."""
    rules: str | None = None
    """Exclusion rules: preregistered (if not given) or official-code."""
    expected: Path | None = None
    """Table of the stimuli (stimulus) that each session, or each scenario, must have; if not given,
    expected.csv beside the responses, else those that half of the scenario's sessions answered."""
    accept_rules: tuple[str, ...] = ()
    """Exclusion rules that may leave out more than a third of a scenario's sessions."""
    simulated: bool = False
    """Rehearse with the simulated participants of --responses alone; the table is marked."""
    exclude: Path | None = None
    """File of stimuli to exclude, one a line."""
    ledge: bool = False
    """Keep the Roll stimuli with a ledge, which the study excluded."""
    later: bool = False
    """Only trials whose contact, if any, is later than the observed part."""
    scenario: str = "mean"
    """One scenario, or mean (with equal weights), or pooled."""
    sort: str = "accuracy"
    """Column to sort by."""
    ascending: bool = False
    """Sort ascending; by default the best is first."""
    model: tuple[str, ...] = ()
    """Only models whose names contain one of these."""
    readout: tuple[str, ...] = ()
    """Only these readouts, such as observed."""
    training: tuple[str, ...] = ()
    """Only models with these trainings, such as all."""
    complete: bool = False
    """Only models that predict all stimuli."""
    license: str = ""
    """Licence of the table, which the files state."""
    date: str = ""
    """Date in the files; that of today (UTC) if not given."""
    out: Path | None = None
    """Folder for leaderboard.html, .csv and .json, and leaderboard_by_scenario.csv."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print the table; return 1 if a file could not be compared."""
    from physion.cli.output import print_warnings

    board = _board(options)
    print_warnings(board.warnings)
    record = _record(board)
    if options.out is not None:
        _write(board, record, options.out, options.sort)
    if options.json:
        print(json_module.dumps(record))
    else:
        _print(_rows(board))
        _print_notes(board)
    return 1 if len(board.refused) else 0


def _board(options: Options) -> Leaderboard:
    from dataclasses import replace

    from physion.analysis.leaderboard.leaderboard import leaderboard
    from physion.analysis.leaderboard.submissions import Filters
    from physion.analysis.tables.responses import (
        LABELS_FILE,
        find_next_to,
        read_humans,
        read_labels,
    )
    from physion.analysis.tables.stimuli import read_stimulus_list

    humans, labels = options.humans, options.labels
    if labels is None and humans is not None:
        labels = find_next_to(humans, "stimuli", LABELS_FILE)
    board = leaderboard(
        options.predictions,
        None if humans is None else read_humans(humans),
        None if labels is None else read_labels(labels),
        scenario=options.scenario,
        exclude=() if options.exclude is None else read_stimulus_list(options.exclude),
        exclude_ledge=not options.ledge,
        later=options.later,
        filters=Filters(options.model, options.readout, options.training),
        complete=options.complete,
        by=options.sort,
        ascending=True if options.ascending else None,
        **_people(options),
    )
    return replace(board, settings={**board.settings, **_provenance(options, labels)})


def _provenance(options: Options, labels: Path | None) -> dict[str, str]:
    """Return program, date, licence, and the digests of the files about people, as text."""
    from datetime import UTC, datetime

    from physion.core.files import file_sha256
    from physion.core.version import __version__

    given = [*options.responses, options.sessions, labels]
    files = [path for path in given if path is not None]
    if options.humans is not None:
        files += sorted(options.humans.glob("human_accuracy-*.csv"))
    stated = {
        "Made with": f"physion {__version__}",
        "Date": options.date or f"{datetime.now(UTC).date()}",
        "Licence": options.license or "not stated; each file has its own",
    }
    if files:
        digests = ", ".join(f"{path.name} {file_sha256(path)[:12]}" for path in files)
        stated["People and outcomes, SHA-256"] = digests
    return stated


def _people(options: Options) -> dict[str, Any]:
    """Return the responses, and the options about them."""
    from physion.analysis.people.completeness import find_expected, read_expected
    from physion.analysis.people.results import read_any_responses, rules_called
    from physion.core.errors import BadInputError

    if not options.responses:
        about = (options.sessions, options.rules, options.expected, options.accept_rules)
        if any(about) or options.simulated:
            raise BadInputError(
                "--sessions, --rules, --expected, --accept-rules and --simulated are about "
                "--responses"
            )
        return {}
    settings: dict[str, Any] = {
        "responses": read_any_responses(
            options.responses, options.sessions, "simulated" if options.simulated else "people"
        ),
        "accept_rules": options.accept_rules,
    }
    if options.rules is not None:
        settings["rules"] = rules_called(options.rules)
    expected = options.expected or find_expected(options.responses)
    if expected is not None:
        settings["expected"] = read_expected(expected)
    return settings


def _record(board: Leaderboard) -> dict[str, Any]:
    """Return the board as JSON values; NaN is null."""
    tables = {"rows": board.table, "anchors": board.anchors, "by_scenario": board.by_scenario}
    tables |= {"dropped": board.dropped, "refused": board.refused}
    if board.dropped_answers is not None:
        tables["dropped_answers"] = board.dropped_answers
    record: dict[str, Any] = {
        name: json_module.loads(table.to_json(orient="records", double_precision=15))
        for name, table in tables.items()
    }
    return {**record, "settings": dict(board.settings), "warnings": list(board.warnings)}


def _rows(board: Leaderboard) -> pd.DataFrame:
    """Return the models, the anchors of the files, and the computed anchors."""
    import pandas as pd

    parts = [part for part in (board.table, board.anchors) if len(part)]
    return pd.concat(parts, ignore_index=True)


def _write(board: Leaderboard, record: dict[str, Any], folder: Path, sorted_by: str) -> None:
    from physion.cli.output import write_text
    from physion.report.leaderboard_page import leaderboard_page
    from physion.report.write import write_csv

    folder.mkdir(parents=True, exist_ok=True)
    tables = {"leaderboard": _rows(board), "leaderboard_by_scenario": board.by_scenario}
    for name, table in tables.items():
        write_csv(folder / f"{name}.csv", table, bool(board.mark))
    write_text(folder / "leaderboard.json", json_module.dumps(record, indent=1) + "\n")
    write_text(folder / "leaderboard.html", leaderboard_page(board, sorted_by))


def _print(table: pd.DataFrame) -> None:
    from physion.cli.output import console
    from physion.cli.text_table import text_table

    shown = _shown(table)
    text = []
    for kind, title in GROUPS.items():
        own = shown[(table["kind"] == kind).to_numpy()]
        if kind != "model":
            own = own.drop(columns=["rank", "ranks"], errors="ignore")
        if len(own):
            text.append(text_table(own, title))
    console.print("\n\n".join(text), markup=False, soft_wrap=True)


def _shown(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns for the console as text; those that are empty in all rows are left out."""
    from physion.analysis.metrics import leaderboard_metrics

    # To keep lines short: what is nearly another column is in the files alone.
    hidden = {"difference", "kappa_within_outcomes"}
    if table["kappa"].notna().any():
        hidden.add("kappa_from_averages")
    metrics = [one.name for one in leaderboard_metrics() if one.name not in hidden]
    spread = [_ranks(row) for row in table.to_dict("records")]
    columns = [*SHOWN, *metrics, *NORMALISED, "versions", "file"]
    shown = table.assign(ranks=spread)[columns].copy()
    for name in NORMALISED:
        shown[name] = ["" if value != value else f"{value:.2f}" for value in table[name]]
    for name in ("scenarios", "stimuli"):
        shown[name] = [
            f"{row[name]}"
            if row[name] == row[f"of_{name}"]
            else f"{row[name]} of {row[f'of_{name}']}"
            for row in table.to_dict("records")
        ]
    for name in metrics:
        shown[name] = [_interval(row, name) for row in table.to_dict("records")]
    empty = [name for name in shown.columns if shown[name].isin(["", None]).all()]
    return shown.drop(columns=empty)


def _print_notes(board: Leaderboard) -> None:
    """Print what was ranked last, refused and left out, and the exclusion rules."""
    partial = board.table[board.table["stimuli"] < board.table["of_stimuli"]]
    notes = [f"not whole, so after those that are: {row.model}: {row.reason}" for row in
             partial.itertuples()]  # fmt: skip
    for row in board.refused.itertuples():
        path, reason = str(row.file), str(row.reason)
        notes.append(f"not compared: {reason if path in reason else f'{path}: {reason}'}")
    left_out = int(board.dropped["stimuli"].sum())
    if left_out:
        notes.append(f"{left_out} stimuli left out over all files; reasons with --json or --out")
    if "Exclusions" in board.settings:
        notes.append(board.settings["Exclusions"])
    if board.dropped_answers is not None and len(board.dropped_answers):
        notes.append(f"{int(board.dropped_answers['rows'].sum())} answers of people left out")
    from physion.cli.output import console

    for note in notes:
        console.print(note, markup=False, soft_wrap=True)


def _ranks(row: dict[str, Any]) -> str:
    """Return the interval of the rank; empty if it is not known."""
    low, high = row["rank_low"], row["rank_high"]
    return "" if low != low else f"{low:.0f} to {high:.0f}"


def _interval(row: dict[str, Any], name: str) -> str:
    value, low, high = row[name], row[f"{name}_low"], row[f"{name}_high"]
    if value != value:
        return ""
    return f"{value:.3f}" + ("" if low != low else f" [{low:.3f}, {high:.3f}]")
