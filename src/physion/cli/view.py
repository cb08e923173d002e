"""Write a self-contained page that shows a dataset: movies, passes, motion in 3D, parameters."""

from __future__ import annotations

import json as json_module
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import Stages, print_line
from physion.clips.batch import Imagine
from physion.core.errors import BadInputError
from physion.core.settings import parse_pairs
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.trials.dataset import Dataset, mark_unusable


@dataclass(frozen=True)
class Options:
    """Options of ``physion view``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    out: Path | None = None
    """Output file; default: view.html in the dataset's folder."""
    trials: int = ViewerOptions.trials
    """Maximal number of trials per scenario; the page states how many are left out."""
    details: int = ViewerOptions.details
    """Number of these trials that have all passes and the scene in 3D."""
    scenario: str | None = None
    """Show only this scenario."""
    split: str | None = None
    """Show only this split."""
    predictions: tuple[str, ...] = ()
    """Models whose predictions are shown next to what is true, as particles in 3D, pictures, boxes
    or slots: names (physion ls models) or FILE.py:Class."""
    mark: tuple[str, ...] = ()
    """Mark trials as unusable, TRIAL=REASON, in unusable.csv of the dataset; a study made from it
    takes the next trials of the same preset and outcome. TRIAL= takes a mark back. The page can
    mark trials too, and offers the file."""
    option: tuple[str, ...] = ()
    """Options of these models as NAME=VALUE, such as samples=8."""
    verify: bool = True
    """Compare files with their SHA-256 in the index before they are used."""
    open: bool = False
    """Open the page in the browser."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Write the page and print its size and path."""
    wanted = ViewerOptions(options.trials, options.details, options.scenario, options.split)
    if options.mark:
        mark_unusable(Dataset(options.folder, verify=options.verify), _marks(options.mark))
    out = options.out if options.out is not None else options.folder / "view.html"
    with Stages() as stages:
        imagine = _imagine(options, stages)
        report = build_viewer(
            options.folder, out, wanted, imagine=imagine, verify=options.verify, progress=stages
        )
    if options.json:
        values = {"page": str(report.page), "bytes": report.size}
        print(json_module.dumps(values | {"shown": report.shown, "left_out": report.left_out}))
    else:
        summary = f"{report.shown} trials, {report.left_out} left out, {report.size / 1e6:.1f} MB"
        print_line(f"{summary}: {report.page}")
    if options.open:
        webbrowser.open(report.page.resolve().as_uri())
    return 0


def _marks(given: tuple[str, ...]) -> dict[str, str]:
    """Return the reasons by trial."""
    parts = [text.partition("=") for text in given]
    for text, (trial, sign, _) in zip(given, parts, strict=True):
        if not (trial and sign):
            raise BadInputError(f"--mark takes TRIAL=REASON, not {text!r}")
    return {trial: reason for trial, _, reason in parts}


def _imagine(options: Options, stages: Stages) -> Imagine | None:
    """Return the function that asks the models of ``--predictions``; None without them."""
    if not options.predictions:
        if options.option:
            raise BadInputError("--option is for the models of --predictions, which names none")
        return None
    # Models need libraries that a page without them does not.
    from physion.readout.imagined import imagine_with

    if options.details < 1:
        raise BadInputError(
            "--predictions are shown in trials with details: --details must be at least 1"
        )
    chosen = parse_pairs(options.option, "--option")
    return imagine_with(
        Dataset(options.folder, verify=options.verify), options.predictions, chosen, stages
    )
