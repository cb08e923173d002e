"""Writers of the files of a report: folders, tables, figures."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.report.figures import theme
from physion.report.figures.theme import Plot
from physion.report.page.document import Picture, page_kind


def prepare_folder(folder: Path) -> Path:
    """Make ``folder`` with its ``tables`` and ``figures``, and return the path of the latter."""
    if folder.exists() and not folder.is_dir():
        raise BadInputError(f"{folder} is a file; give a folder for the report")
    for name in ("tables", "figures"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    return folder / "figures"


def write_plot(plot: Plot, folder: Path, rehearsal: bool = False) -> Picture:
    """Write a figure as SVG with text, PDF and PNG with its table; return what the page shows.

    The page shows an SVG with outlined letters, which needs no font. ``rehearsal``: as in
    `write_csv`.
    """
    write_csv(folder / f"{plot.name}.csv", plot.table, rehearsal)
    figure = plot.draw(plot.table, theme.LIGHT)
    light = {kind: theme.figure_bytes(figure, kind) for kind in ("svg", "png")}
    # The dark figure is for the page only, so it is made only in the format used there.
    kind = page_kind(light)
    dark = {kind: theme.figure_bytes(plot.draw(plot.table, theme.DARK), kind)}
    files = {
        "svg": theme.figure_bytes(figure, "svg", text=True),
        "pdf": theme.figure_bytes(figure, "pdf"),
        "png": light["png"],
    }
    for ending, content in files.items():
        write_atomic(folder / f"{plot.name}.{ending}", content)
    return Picture(plot.name, light, dark, plot.words)


def write_csv(path: Path, table: pd.DataFrame, rehearsal: bool = False) -> None:
    """Write a table as CSV, completely or not at all.

    ``rehearsal``: the participants are simulated, which every row then states.
    """
    marked = mark_rehearsal(table) if rehearsal else table
    write_atomic(path, marked.to_csv(index=False, lineterminator="\n").encode())


def mark_rehearsal(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with the column ``rehearsal``, which states that nothing is about people."""
    return table.assign(rehearsal="simulated participants")
