"""From a comparison, or from files, to a folder with the report, its tables and its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from physion.analysis import (
    Bootstrap,
    compare,
    read_human_zone,
    read_humans,
    read_labels,
    read_predictions,
)
from physion.analysis.comparison import Comparison
from physion.analysis.responses import DominoesLook
from physion.analysis.stimuli import read_stimulus_list
from physion.atomic import write_atomic
from physion.errors import BadInputError
from physion.report import figures
from physion.report.page import Picture, ReportInputs, check_movies, page_kind, render_page

LABELS_FILE = "stimulus_names_and_labels.csv"
ZONE_FILE = "human_accuracy_by_scenario.csv"

_LOOKS = {
    "plain": "those who saw free colours with flashing overlays, as in the paper",
    "redyellow": "those who saw a red agent and a yellow patient",
    "pooled": "those of both looks, weighted by their number",
}


def build_report(inputs: ReportInputs, folder: Path) -> Path:
    """Write ``report.html``, ``tables/*.csv`` and ``figures/*.{svg,png,csv}``; the page's path.

    The page needs none of the other files. Every file is whole or absent, the page comes last, and
    the same inputs give the same bytes. Raises `BadInputError`, before anything is written, where
    ``folder`` is a file or a movie is not one.
    """
    if folder.exists() and not folder.is_dir():
        raise BadInputError(f"{folder} is a file; give a folder for the report")
    check_movies(inputs)
    tables, pictures = folder / "tables", folder / "figures"
    for place in (tables, pictures):
        place.mkdir(parents=True, exist_ok=True)
    for name, table in comparison_tables(inputs.comparison).items():
        _write_csv(tables / f"{name}.csv", table)
    shown = _write_figures(inputs, pictures)
    page = folder / "report.html"
    write_atomic(page, render_page(inputs, shown).encode())
    return page


def comparison_tables(comparison: Comparison) -> dict[str, pd.DataFrame]:
    """The tables of a comparison by the name of their file."""
    tables = {
        "comparison": comparison.scores,
        "people": comparison.people,
        "stimuli": comparison.stimuli,
        "changed_outcomes": comparison.changed,
        "left_out": comparison.dropped,
    }
    return {name: table for name, table in tables.items() if len(table.columns)}


def compare_files(
    predictions: list[Path],
    humans: Path | None,
    labels: Path | Mapping[str, bool] | None,
    folder: Path,
    *,
    zone: Path | None = None,
    exclude: Path | None = None,
    exclude_ledge: bool = True,
    dominoes: DominoesLook = "plain",
    bootstrap: Bootstrap | None = None,
    methods: Mapping[str, str] | None = None,
    movies: Mapping[str, Path] | None = None,
) -> Path:
    """Compare predictions in CSV files with people and write the report; the page's path.

    ``humans``: folder of ``human_accuracy-*.csv``, or None. ``labels``: a CSV file with ``stim_ID``
    and ``label``, or outcomes by stimulus; None looks for the official file in ``humans``, beside
    it, and in ``stimuli`` beside it, then goes by *Recorded Outcome* of the predictions.
    ``zone``: the official table of participants' percentiles; None looks for it likewise, in
    ``results``, and goes on without. ``exclude``: a file of stimuli to leave out, one a line.
    ``methods``: see `ReportInputs`. Raises `BadInputError`, before anything is written.
    """
    people = None if humans is None else read_humans(humans, dominoes)
    labels = labels if labels is not None else _beside(humans, "stimuli", LABELS_FILE)
    zone = zone if zone is not None else _beside(humans, "results", ZONE_FILE)
    rows = read_predictions(predictions)
    if people is not None and labels is None and rows["recorded"].isna().all():
        raise BadInputError(f"no {LABELS_FILE} lies near {humans}; give the file with the labels")
    comparison = compare(
        rows,
        people,
        read_labels(labels) if isinstance(labels, Path) else labels,
        zone=read_human_zone(zone) if zone is not None and people is not None else None,
        exclude=read_stimulus_list(exclude) if exclude is not None else (),
        exclude_ledge=exclude_ledge,
        bootstrap=bootstrap,
    )
    choices = dict(methods or {})
    if people is not None:
        origin = labels.name if isinstance(labels, Path) else "those recorded with the trials"
        choices.setdefault("Official outcomes", origin)
        choices.setdefault("People for Dominoes", _LOOKS[dominoes])
    return build_report(ReportInputs(comparison, methods=choices, movies=movies or {}), folder)


def _beside(humans: Path | None, sibling: str, name: str) -> Path | None:
    """The official file ``name`` near the folder of people's answers, if it is there."""
    if humans is None:
        return None
    parent = humans.resolve().parent
    places = (humans / name, parent / name, parent / sibling / name)
    return next((place for place in places if place.is_file()), None)


def _write_figures(inputs: ReportInputs, folder: Path) -> list[Picture]:
    """Write each figure as SVG and PNG with its data beside it; those that the page shows."""
    comparison = inputs.comparison
    drawn = ["accuracy", *(["scatter"] if comparison.has_people else [])]
    data = {"accuracy": figures.accuracy_data, "scatter": figures.scatter_data}
    shown = []
    for name in drawn:
        _write_csv(folder / f"{name}.csv", data[name](comparison))
        light = _draw(name, inputs, figures.LIGHT, ("svg", "png"))
        # The dark figure is for the page alone, so it is drawn in the one kind that goes there.
        dark = _draw(name, inputs, figures.DARK, (page_kind(light),))
        for kind, content in light.items():
            write_atomic(folder / f"{name}.{kind}", content)
        shown.append(Picture(name, light, dark))
    return shown


def _draw(
    name: str, inputs: ReportInputs, theme: figures.Theme, kinds: Sequence[str]
) -> dict[str, bytes]:
    if name == "accuracy":
        figure = figures.accuracy_figure(inputs.comparison, theme)
    else:
        figure = figures.scatter_figure(inputs.comparison, inputs.scatter_agents(), theme)
    return {kind: figures.figure_bytes(figure, kind) for kind in kinds}


def _write_csv(path: Path, table: pd.DataFrame) -> None:
    write_atomic(path, table.to_csv(index=False, lineterminator="\n").encode())
