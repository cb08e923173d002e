"""The published numbers of the original study next to those recomputed from its released tables.

Prints the accuracies by model and scenario as published (means over readouts, trainings and seeds)
and as a reader expects them (trained on all scenarios, readout observed+simulated), the panels of
the main figure, supplementary figures, the regressions of the Results section with what differs,
and people.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    import pandas as pd

    from physion.analysis.published.claims import PublishedResults


@dataclass(frozen=True)
class Options:
    """Where the official data is."""

    folder: Annotated[Path, tyro.conf.Positional] = Path("official")
    """Folder with results/ and humans/ of the original study; official stands for the tables of
    the package."""
    out: Path | None = None
    """Folder for the page, the figures, the tables as CSV files and published.json."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print the tables, and write the page if asked."""
    from physion.analysis.published.claims import published_results
    from physion.cli.output import console
    from physion.data.official import find_official
    from physion.report.published import build_published_report, published_numbers

    data = find_official(options.folder)
    results = published_results(options.folder if data is None else data.results.parent)
    page = None if options.out is None else build_published_report(results, options.out)
    if options.json:
        print(json_module.dumps(published_numbers(results), indent=1))
        return 0
    _print(results)
    if page is not None:
        console.print(f"report: {page}", markup=False, soft_wrap=True)
    return 0


def _print(results: PublishedResults) -> None:
    from physion.analysis.published.tables import grid

    tables, words = results.tables, results.descriptions
    accuracies = tables["accuracies"]
    _show("Accuracy as published (means of all released rows)", grid(accuracies, "published"))
    _show("Accuracy, trained on all, observed+simulated", grid(accuracies, "expected"))
    _say(words["accuracies"])
    for name, measure in (("panel_a", "accuracy"), ("panel_c", "kappa")):
        _show(_title(name), _with_interval(tables[name], measure))
    _show(_title("panel_d"), _wide(tables["panel_d"], "readout"))
    _show(_title("panel_e"), _wide(tables["panel_e"], "training"))
    _say(words["panels"])
    _show(_title("accuracy_kappa"), tables["accuracy_kappa"])
    _say(words["accuracy_kappa"])
    _show(_title("figure_s3"), tables["figure_s3"])
    _show(_title("not_made"), tables["not_made"])
    _regressions(tables["regressions"])
    _say(words["regressions"])
    people = ["scenario", "accuracy", "zone_low", "zone_high", "kappa", "half_r", "half_r_full"]
    counts = ["participants", "stimuli", "below_chance"]
    _show(_title("people"), tables["people"][[*people, *counts]])
    _show(_title("people_claims"), tables["people_claims"])
    _say(words["people"])
    if len(tables["left_out"]):
        _show(_title("left_out"), tables["left_out"])


def _title(name: str) -> str:
    from physion.analysis.published.claims import TITLES

    return TITLES[name]


def _with_interval(table: pd.DataFrame, measure: str) -> pd.DataFrame:
    """The rows of the mean over scenarios, with interval and the paper's grey band."""
    mean = table[table["scenario"] == "mean"]
    return mean[["model", measure, "low", "high", "people", "zone_low", "zone_high", "in_zone"]]


def _wide(table: pd.DataFrame, column: str) -> pd.DataFrame:
    names = list(dict.fromkeys(table["model"])), list(dict.fromkeys(table[column]))
    wide = table.pivot(index="model", columns=column, values="accuracy")
    return wide.reindex(index=names[0], columns=names[1]).reset_index()


def _regressions(table: pd.DataFrame) -> None:
    import pandas as pd

    from physion.cli.output import console

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
    _show(_title("regressions"), pd.DataFrame(rows))
    for row in table.to_dict("records"):
        told = f"{row['claim']}: compares {row['compared']}. {row['differs']}"
        console.print(told, markup=False, soft_wrap=True)


def _estimate(row: dict[str, object], fit: str) -> str:
    b, t, df, p = (float(str(row[f"{fit}_{name}"])) for name in ("b", "t", "df", "p"))
    return f"b {b:.3f}, t({df:.0f}) {t:.1f}, p {p:.1g}"


def _show(title: str, table: pd.DataFrame) -> None:
    from physion.cli.output import text_table

    _say(text_table(table, title))


def _say(text: str) -> None:
    from physion.cli.output import console

    console.print(text + "\n", markup=False, soft_wrap=True)
