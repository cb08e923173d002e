"""Write one self-contained page that shows a dataset: movies, passes, motion in 3D, parameters."""

from __future__ import annotations

import json as json_module
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import console, track
from physion.report.viewer.write_viewer import ViewerOptions, build_viewer


@dataclass(frozen=True)
class Options:
    """Which dataset, and how much of it."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    out: Path | None = None
    """The page to write; by default view.html in the dataset's folder."""
    trials: int = ViewerOptions.trials
    """Trials of each scenario at most; the page says how many are left out."""
    details: int = ViewerOptions.details
    """So many of them with all passes and the scene in 3D."""
    scenario: str | None = None
    """Only this scenario."""
    split: str | None = None
    """Only this split."""
    open: bool = False
    """Open the page in the browser."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Write the page and print its size and path."""
    wanted = ViewerOptions(options.trials, options.details, options.scenario, options.split)
    out = options.out if options.out is not None else options.folder / "view.html"
    report = build_viewer(options.folder, out, wanted, track=track)
    if options.json:
        values = {"page": str(report.page), "bytes": report.size}
        print(json_module.dumps(values | {"shown": report.shown, "left_out": report.left_out}))
    else:
        words = f"{report.shown} trials, {report.left_out} left out, {report.size / 1e6:.1f} MB"
        console.print(f"{words}: {report.page}", markup=False, soft_wrap=True)
    if options.open:
        webbrowser.open(report.page.resolve().as_uri())
    return 0
