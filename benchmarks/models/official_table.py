"""Print the rows of all models on the official stimuli, as in ``docs/results/models.md``.

    physion compare PREDICTIONS... --humans official --out FOLDER
    python benchmarks/models/official_table.py FOLDER [--write]

Published rows, which stand beside them on the page, are left out. With --write the accuracies and
likeness by scenario are written to ``results/official_all.csv``, with four digits.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

RESULTS = Path(__file__).parents[1] / "results" / "official_all.csv"
MEASURES = ("accuracy", "r", "kappa", "beyond")


def shown(value: float) -> str:
    """Return two digits, - for nothing."""
    if pd.isna(value):
        return "-"
    return f"{value:.2f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.0f}"


def measured(row: pd.Series, name: str) -> str:
    """Return a measure with its interval."""
    if pd.isna(row[f"{name}_low"]):
        return shown(row[name])
    return f"{shown(row[name])} ({shown(row[f'{name}_low'])} to {shown(row[f'{name}_high'])})"


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="of physion compare")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    tables = options.folder / "tables"
    results = pd.read_csv(tables / "results.csv")
    for _, row in results[results["source"].isna()].iterrows():
        name, _, readout = str(row["row"]).partition(" · ")
        cells = [measured(row, measure) for measure in MEASURES]
        print(f"| {name} | {f'*{readout}*' if readout else ''} | {' | '.join(cells)} |")
    if options.write:
        pd.read_csv(tables / "comparison.csv").round(4).to_csv(RESULTS, index=False)


if __name__ == "__main__":
    main()
