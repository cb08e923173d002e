"""Page of the published results: the printed numbers and those that a reader expects."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from physion.analysis.figure_tables import (
    GROUPED_COLUMNS,
    MEASURE_COLUMNS,
    PARTICIPANTS,
    SCENARIO_ZONE,
)
from physion.analysis.published.claims import TITLES, PublishedResults, results_of
from physion.analysis.published.tables import grid, read_published
from physion.analysis.tables import MEAN, records
from physion.core.files import write_atomic
from physion.core.html import Markup, joined
from physion.core.version import MADE_WITH
from physion.data.official import PACKAGED, find_official
from physion.report.build import prepare_folder, write_csv, write_plot
from physion.report.figures.by_scenario import measure_figure, model_and_people_figure
from physion.report.figures.by_stimulus import difficulty_figure
from physion.report.figures.theme import Plot
from physion.report.figures.training import grouped_figure
from physion.report.html import (
    MACROS,
    PageColumn,
    Section,
    compared,
    details,
    figure,
    interval,
    number,
    p_value,
    paragraph,
    render_document,
    rows_table,
    table,
)

TITLE = "The published results of the original study, recomputed from its released tables"


def recompute_published(humans: Path | str = PACKAGED) -> PublishedResults:
    """Recompute the published numbers from the released tables: the package's, or of a folder."""
    data = find_official(humans)
    return results_of(read_published(Path(humans) if data is None else data.results.parent))


def build_published_report(results: PublishedResults, folder: Path) -> Path:
    """Write ``report.html``, ``published.json``, ``tables/*.csv``, ``figures/*``; return the page's
    path.

    The same inputs give the same bytes. Raises `BadInputError` if ``folder`` is a file.
    """
    pictures = prepare_folder(folder)
    for name, rows in results.tables.items():
        write_csv(folder / "tables" / f"{name}.csv", rows)
    shown = {plot.name: figure(write_plot(plot, pictures)) for plot in published_plots(results)}
    text = json.dumps(published_numbers(results), indent=1, allow_nan=False)
    write_atomic(folder / "published.json", f"{text}\n".encode())
    page = folder / "report.html"
    write_atomic(page, _page(results, shown).encode())
    return page


def published_numbers(results: PublishedResults) -> dict[str, Any]:
    """Return every table, as a list of rows, and its description for JSON; NaN becomes null."""
    tables = {name: records(rows) for name, rows in results.tables.items()}
    return {"package": MADE_WITH, "tables": tables, "words": dict(results.descriptions)}


# --- text ---------------------------------------------------------------------------------------


def published_parts(results: PublishedResults) -> Iterator[tuple[str, pd.DataFrame | None]]:
    """Yield what a terminal shows: titles with their tables, and paragraphs without one."""
    tables, words = results.tables, results.descriptions
    accuracies = tables["accuracies"]
    yield "Accuracy as published (means of all released rows)", grid(accuracies, "published")
    yield "Accuracy, trained on all, observed+simulated", grid(accuracies, "expected")
    yield words["accuracies"], None
    for name, measure in (("panel_a", "accuracy"), ("panel_c", "kappa")):
        table = tables[name]
        ends = ["low", "high", "people", "zone_low", "zone_high", "in_zone"]
        yield TITLES[name], table[table["scenario"] == MEAN][["model", measure, *ends]]
    for name, column in (("panel_d", "readout"), ("panel_e", "training")):
        yield TITLES[name], _wide(tables[name], column)
    yield words["panels"], None
    yield TITLES["accuracy_kappa"], tables["accuracy_kappa"]
    yield words["accuracy_kappa"], None
    for name in ("figure_s3", "not_made"):
        yield TITLES[name], tables[name]
    yield TITLES["regressions"], _regression_rows(tables["regressions"])
    claims = tables["regressions"].to_dict("records")
    compares = [f"{row['claim']}: compares {row['compared']}. {row['differs']}" for row in claims]
    yield "\n".join([*compares, words["regressions"]]), None
    people = ["scenario", "accuracy", "accuracy_low", "accuracy_high", "printed", "zone_low"]
    people += ["zone_high", "kappa", "half_r", "half_r_full"]
    counts = ["participants", "stimuli", "below_chance"]
    yield TITLES["people"], tables["people"][[*people, *counts]]
    yield TITLES["people_claims"], tables["people_claims"]
    yield words["people"], None
    if len(tables["left_out"]):
        yield TITLES["left_out"], tables["left_out"]


def _wide(table: pd.DataFrame, column: str) -> pd.DataFrame:
    names = list(dict.fromkeys(table["model"])), list(dict.fromkeys(table[column]))
    wide = table.pivot(index="model", columns=column, values="accuracy")
    return wide.reindex(index=names[0], columns=names[1]).reset_index()


def _regression_rows(table: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for row in table.to_dict("records"):
        printed = [f"{key} {row[f'printed_{key}']}" for key in "btp" if row[f"printed_{key}"]]
        rows.append(
            {
                "claim": row["claim"],
                "printed": ", ".join(printed),
                **{fit: _estimate(row, fit) for fit in ("run", "once", "asked")},
                "figures": row["met"],
            }
        )
    return pd.DataFrame(rows)


def _estimate(row: Mapping[Any, Any], fit: str) -> str:
    b, t, df, p = (float(str(row[f"{fit}_{name}"])) for name in ("b", "t", "df", "p"))
    return f"b {b:.3f}, t({df:.0f}) {t:.1f}, p {p:.1g}"


# --- figures ------------------------------------------------------------------------------------


def published_plots(results: PublishedResults) -> list[Plot]:
    """Return panels A, C, D and E of the paper's main figure, and figures S1 (top) and S3."""
    tables, words = results.tables, results.descriptions["panels"]
    rows = tables["panel_a"]
    people = float(rows.loc[rows["scenario"] == MEAN, "people"].iloc[0])
    return [
        Plot(
            "panel_a",
            f"{TITLES['panel_a']}. {_ACCURACY}",
            _measure(tables["panel_a"], "accuracy", PARTICIPANTS),
            partial(measure_figure, measure="accuracy"),
        ),
        Plot(
            "panel_c",
            f"{TITLES['panel_c']}. {_KAPPA}",
            _measure(tables["panel_c"], "kappa", "95 % of pairs of participants"),
            partial(measure_figure, measure="kappa"),
        ),
        Plot(
            "panel_d",
            f"{TITLES['panel_d']}. {words}",
            _grouped(tables["panel_d"], "readout", "by readout (trained on all)", people),
            grouped_figure,
        ),
        Plot(
            "panel_e",
            f"{TITLES['panel_e']}. Readout observed+simulated.",
            _grouped(
                tables["panel_e"], "training", "by training (readout observed+simulated)", people
            ),
            grouped_figure,
        ),
        Plot(
            "figure_s1",
            f"{TITLES['figure_s1']}. {_BELOW_CHANCE}",
            tables["figure_s1"],
            difficulty_figure,
        ),
        Plot(
            "figure_s3",
            f"{TITLES['figure_s3']}. {_DPI}",
            tables["figure_s3"],
            model_and_people_figure,
        ),
    ]


_BELOW_CHANCE = (
    "Hatched: stimuli that people get wrong more often than by guessing, by the study's rule "
    "(accuracy + 1.96 standard errors below 0.5) and by an exact test corrected for the number of "
    "stimuli. Roll's ledges are left out."
)
_DPI = (
    "Trained on all scenarios, readout observed+simulated. Below the diagonal the model is more "
    "accurate than people; it is given the true states and was tested on all test stimuli, also on "
    "those that people did not see."
)
_SHOWN = (
    "Trained on all scenarios, readout observed+simulated. Dashed: people. Grey: the middle 95 % "
    "of {of}. Hatched, in the mean: the band of the paper, a bootstrap over the scenario means. "
    "Intervals of the mean draw scenarios{more}."
)
_ACCURACY = _SHOWN.format(of="participants", more="; single runs have none")
_KAPPA = _SHOWN.format(
    of="pairs of participants", more="; others are percentiles over participants"
)


def _measure(panel: pd.DataFrame, measure: str, zone: str) -> pd.DataFrame:
    rows = panel.rename(columns={"scenario": "panel", measure: "value"})
    is_mean = rows["panel"] == MEAN
    rows = rows.assign(kind="", people_is="people", reason="", zone=zone)
    rows["zone"] = rows["zone"].mask(is_mean, SCENARIO_ZONE)
    order = list(dict.fromkeys(rows.loc[~is_mean, "panel"]))
    rank = rows["panel"].map({name: at for at, name in enumerate(order)}).fillna(len(order))
    return rows.assign(place=rank).sort_values("place", kind="stable")[list(MEASURE_COLUMNS)]


def _grouped(panel: pd.DataFrame, column: str, name: str, people: float) -> pd.DataFrame:
    rows = panel.rename(columns={column: "group", "accuracy": "value"})
    rows = rows.assign(panel=name, people=people, stimuli=float("nan"), reason="")
    return rows[list(GROUPED_COLUMNS)].reset_index(drop=True)


# --- page ---------------------------------------------------------------------------------------


def _page(results: PublishedResults, shown: dict[str, Markup]) -> str:
    tables, words = results.tables, results.descriptions
    models = tables["accuracies"]["model"].nunique()
    lead = paragraph(
        f"{models} models and people on {tables['accuracies']['scenario'].nunique()} scenarios: "
        "what was printed, what it averages or compares, and what a reader expects.",
        "lead",
    )
    panels = [
        shown["panel_a"],
        _panel(tables["panel_a"], "accuracy"),
        shown["panel_c"],
        _panel(tables["panel_c"], "kappa"),
    ]
    sections = [
        Section("Accuracies by scenario", _accuracies(results)),
        Section("Panels A and C", joined(panels)),
        Section("Panels D and E", shown["panel_d"] + shown["panel_e"]),
        Section("Accuracy and kappa", _accuracy_kappa(results)),
        Section("Supplementary figures", _supplement(results, shown)),
        Section("Regressions of the Results section", _regressions(results)),
        Section("People", _people(tables["people"], tables["people_claims"], words["people"])),
        Section("Rows left out", _left_out(tables["left_out"])),
    ]
    return render_document(TITLE, lead, sections)


def _accuracies(results: PublishedResults) -> Markup:
    rows = results.tables["accuracies"]
    parts = [paragraph(results.descriptions["accuracies"])]
    for column, caption in (
        ("published", "As published: means of all released rows"),
        ("expected", "As a reader expects: trained on all, readout observed+simulated"),
        ("difference", "Expected less published"),
    ):
        wide = grid(rows, column)
        names = [name for name in wide.columns if name != "model"]
        marks = _reliably(rows) if column == "published" else {}
        cells = [
            [
                str(row["model"]),
                *(compared(number(row[n], 3), marks.get((row["model"], n), "")) for n in names),
            ]
            for _, row in wide.iterrows()
        ]
        if column == "published":
            cells.insert(0, _people_row(results.tables["people"], names))
            caption += _MARKED
        parts.append(table(["model", *names], cells, caption))
    columns = [
        PageColumn("model", "model", "text"),
        PageColumn("scenario", "scenario", "text"),
        PageColumn("published", "published", "interval", 3),
        PageColumn(
            "interval by the paper's way", "published", "interval", 3, "paper_low", "paper_high"
        ),
        PageColumn("rows", "rows", "count"),
        PageColumn("observed once", "without_copies", digits=3),
        PageColumn("expected", "expected", "interval", 3),
        PageColumn("runs", "runs", "count"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("difference", "difference", digits=3),
    ]
    parts.append(details("Every value with its interval", rows_table(rows, columns)))
    return joined(parts)


_MARKED = (
    "; italics: reliably worse than people, bold: reliably better: the interval by the paper's way "
    "and the bootstrap of people do not overlap"
)


def _reliably(rows: pd.DataFrame) -> dict[tuple[str, str], str]:
    marks: dict[tuple[str, str], str] = rows.set_index(["model", "scenario"])["reliably"].to_dict()
    return marks


def _people_row(people: pd.DataFrame, names: Sequence[str]) -> list[str]:
    """Return the accuracy of people by scenario, with the interval by drawing participants."""
    rows = people.set_index("scenario").loc[list(names)]
    return ["people", *(interval(row, "accuracy", digits=3) for _, row in rows.iterrows())]


def _panel(rows: pd.DataFrame, measure: str) -> Markup:
    columns = [
        PageColumn("model", "model", "text"),
        PageColumn("scenario", "scenario", "text"),
        PageColumn(measure, measure, "interval", 3, "low", "high"),
        PageColumn("people", "people", "interval", 3, "zone_low", "zone_high"),
        PageColumn("in zone", "in_zone", "text"),
    ]
    words = rows.assign(in_zone=rows["in_zone"].map({True: "yes", False: "no"}))
    return details(f"{measure} as a table", rows_table(words, columns))


def _accuracy_kappa(results: PublishedResults) -> Markup:
    columns = [
        PageColumn("over", "over", "text"),
        PageColumn("models", "models", "count"),
        PageColumn("points", "points", "count"),
        PageColumn("r", "r", "interval", 3),
    ]
    rows = rows_table(results.tables["accuracy_kappa"], columns)
    return paragraph(results.descriptions["accuracy_kappa"]) + rows


def _supplement(results: PublishedResults, shown: dict[str, Markup]) -> Markup:
    cells = [[str(text) for text in row] for row in results.tables["not_made"].to_numpy()]
    missing = table(["figure", "why it is missing"], cells, TITLES["not_made"])
    return shown["figure_s1"] + shown["figure_s3"] + missing


def _regressions(results: PublishedResults) -> Markup:
    cells = []
    for _, row in results.tables["regressions"].iterrows():
        printed = ", ".join(f"{k} {row[f'printed_{k}']}" for k in "btp" if row[f"printed_{k}"])
        fits = [
            f"b {number(row[f'{fit}_b'], 3)}, t({number(row[f'{fit}_df'], 0)}) = "
            f"{number(row[f'{fit}_t'], 1)}, p {p_value(row[f'{fit}_p'])}"
            for fit in ("run", "once", "asked")
        ]
        about = MACROS.with_small(row["claim"], row["sentence"])
        differs = str(f"Compares {row['compared']} ({row['state']}): {row['differs']}")
        cells.append([about, str(printed), *fits, str(row["met"]), differs])
    header = [
        "claim",
        "printed",
        "as run",
        "each row once",
        "as the sentence asks",
        "figures met",
        "what differs",
    ]
    return paragraph(results.descriptions["regressions"]) + table(header, cells)


def _people(rows: pd.DataFrame, claims: pd.DataFrame, description: str) -> Markup:
    columns = [
        PageColumn("scenario", "scenario", "text"),
        PageColumn("accuracy (participants drawn)", "accuracy", "interval", 3),
        PageColumn("printed", "printed", digits=3),
        PageColumn("zone from", "zone_low", digits=3),
        PageColumn("to", "zone_high", digits=3),
        PageColumn("kappa", "kappa", "interval", 3, "kappa_low", "kappa_high"),
        PageColumn("r of halves", "half_r", "interval", 3),
        PageColumn("stepped up", "half_r_full", digits=3),
        PageColumn("participants", "participants", "count"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("below chance", "below_chance", "count"),
    ]
    said = [
        PageColumn("claim", "claim", "text"),
        PageColumn("printed", "printed", "text"),
        PageColumn("here", "ours", "text"),
        PageColumn("note", "note", "text"),
    ]
    return (
        paragraph(description)
        + rows_table(
            rows,
            columns,
            "Printed: the row of people in the paper's table. Zones are 2.5 to 97.5 % of "
            "participants, or of pairs (kappa); in the mean the paper's",
        )
        + rows_table(claims, said, "What the paper says of people")
    )


def _left_out(rows: pd.DataFrame) -> Markup:
    if rows.empty:
        return paragraph("None.")
    columns = [PageColumn(name, name, "text") for name in rows.columns]
    return rows_table(rows, columns)
