"""The page of the paper's claims: tables, figure 4 and matrices, published and own.

    python benchmarks/models/paper_page.py --write

`paper_table` trains models under every protocol, and stores parts in ``results/paper``: predictions
as ``MODEL_PROTOCOL.csv.gz``, and how they were trained as ``MODEL_PROTOCOL.json``. The page of all
that are stored, and of the weights of the package, is ``docs/results/paper.md``; its figures are
those of `physion.report`, with the published models and ours as rows or panels of one figure.
"""

from __future__ import annotations

import argparse
import datetime
import gzip
import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from paper_claims import (
    GENERALISED,
    NAMES,
    NEITHER,
    NOT_COMPUTED,
    RESULTS,
    SIMULATED,
    TESTED,
    Tested,
    averaged,
    claims,
    panel_rows,
    stored_official,
    stored_own,
    tested_of,
)
from physion.analysis.comparison import ANOTHER
from physion.analysis.published.claims import (
    PublishedResults,
)
from physion.analysis.published.tables import (
    MODELS,
    SELECTION,
    PublishedTables,
    figure_s1,
    figure_s3,
    panel_a,
    panel_c,
    panel_d,
    panel_e,
    read_published,
)
from physion.analysis.tables import ALL_BUT, MEAN, ONLY
from physion.compute.tasks import processor
from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.core.names import SCENARIOS
from physion.core.tables import markdown_table
from physion.data.official import official
from physion.report.build import prepare_folder, write_csv, write_plot
from physion.report.figures.by_scenario import measure_figure
from physion.report.figures.theme import Plot
from physion.report.figures.training import generalization_figure, grouped_figure
from physion.report.published import published_plots

PAGE = Path(__file__).parents[2] / "docs" / "results" / "paper.md"
PARTS = RESULTS / "paper"
COLUMNS = ("model", "readout", "protocol", "dynamics_training_dataset", "seed", "stimulus",
           "scenario", "p_contact", "outcome")  # fmt: skip
"""Columns of predictions that are stored."""
PROTOCOLS = ("all", "all-but", "only", "one")
HELD_OUT = 0.02
"""Relative change of the held-out loss in the last third of a training that counts as none."""
DIFFERENT = ("opposite", "not shown here", "shown only here")
PUBLISHED, PACKAGE, HERE = "published", "weights of the package", "trained for this page"
KINDS = {"shipped_official": PACKAGE, "official": HERE}
"""Kinds of models in the figures, all on official stimuli."""
SUFFIXES = {PUBLISHED: "", PACKAGE: " (package)", HERE: " (here)"}
SETS = {
    "shipped_official": "weights of the package, official stimuli",
    "shipped_own": "weights of the package, own trials",
    "official": "trained for this page, official stimuli",
    "own": "trained for this page, own trials",
}
"""Models and the trials that they are tested on. People saw the official stimuli."""


@dataclass(frozen=True)
class Stored:
    """A model that was trained under a protocol, and its predictions.

    - ``model``, ``protocol``: name here, and all, only, all-but or one.
    - ``scale``: fields of `paper_table.Scale`. ``steps``: of a training.
    - ``rendered``: whether pictures were rendered, not read from movies.
    - ``losses``: of each training, held-out, after two thirds of the steps and at the end.
    - ``made``: date and processor.
    - ``predictions``: rows of `physion evaluate`, with ``tested``: the set of the trial.
    """

    model: str
    protocol: str
    scale: Mapping[str, Any]
    steps: int
    rendered: bool
    losses: Sequence[tuple[float, float]]
    made: str
    predictions: pd.DataFrame

    @property
    def steady(self) -> int:
        """Number of trainings whose held-out loss hardly changed in the last third."""
        return sum(abs(last / before - 1) <= HELD_OUT for before, last in self.losses)

    def trials(self, tested: str) -> frozenset[tuple[str, bool]]:
        """Return name and outcome of each trial of a tested set."""
        rows = self.predictions[self.predictions["tested"] == tested]
        return frozenset(zip(rows["stimulus"], rows["outcome"].astype(bool), strict=True))

    def write(self, folder: Path = PARTS) -> None:
        """Write the part, in place of an earlier one of its name."""
        folder.mkdir(parents=True, exist_ok=True)
        about = {field.name: getattr(self, field.name) for field in fields(self)[:-1]}
        name = f"{self.model}_{self.protocol}"
        text = self.predictions[["tested", *COLUMNS]].to_csv(index=False, float_format="%.6g")
        write_atomic(folder / f"{name}.csv.gz", gzip.compress(text.encode(), mtime=0))
        write_atomic(folder / f"{name}.json", f"{json.dumps(about, indent=1)}\n".encode())


def read_stored(folder: Path = PARTS) -> list[Stored]:
    """Return all parts in a folder, by protocol and model.

    Raises `BadInputError` if parts have different tested or readout trials, or parts of one model
    different training trials or steps.
    """
    parts = []
    for path in folder.glob("*.json"):
        about = json.loads(path.read_text())
        text = dict.fromkeys(("seed", "protocol", "dynamics_training_dataset"), str)
        table = pd.read_csv(path.with_suffix(".csv.gz"), dtype=text)
        table = table.fillna(dict.fromkeys(text, ""))
        parts.append(Stored(**about, predictions=table))
    order = (list(PROTOCOLS), list(NAMES))
    parts.sort(key=lambda p: (order[0].index(p.protocol), order[1].index(p.model)))
    known: dict[str, tuple[Stored, Any]] = {}
    for part in parts:
        facts: dict[str, Any] = {
            f"tested trials ({name})": part.trials(name) for name in TESTED if part.trials(name)
        }
        facts |= {"readout trials": part.scale["readout"],
                  f"training trials of {part.model}": part.scale["trials"],
                  f"steps of {part.model}": part.steps}  # fmt: skip
        for name, fact in facts.items():
            other, expected = known.setdefault(name, (part, fact))
            if fact != expected:
                raise BadInputError(
                    f"{folder}: {part.model} under {part.protocol} and {other.model} under "
                    f"{other.protocol} differ in {name}; compute one of them again at the scale of "
                    "the other, or remove it"
                )
    return parts


def figures(released: PublishedTables, tested: Mapping[str, Tested]) -> list[Plot]:
    """Return the panels of figure 4 and the matrices, published and own in one figure each."""
    drawn = {KINDS[name]: of for name, of in tested.items() if name in KINDS}
    drawn = {kind: of for kind, of in drawn.items() if len(panel_rows(of.tables))}
    if not drawn:
        return []
    plots = {PUBLISHED: {plot.name: plot for plot in published_plots(panels(released, released))}}
    for kind, of in drawn.items():
        made = published_plots(panels(averaged(of.tables), released))
        plots[kind] = {plot.name: plot for plot in made}
    found = []
    for name, measure in (("panel_a", "accuracy"), ("panel_c", "kappa")):
        table = interleaved({kind: of[name].table for kind, of in plots.items()})
        found.append(Plot(name, "", table, partial(measure_figure, measure=measure)))
    r = interleaved({kind: of.r for kind, of in drawn.items()})
    found.insert(1, Plot("panel_b", "", r, partial(measure_figure, measure="r")))
    for name, column in (("panel_d", "readout"), ("panel_e", "training")):
        parts = [
            plot[name].table.assign(panel=kind)
            for kind, plot in plots.items()
            if kind == PUBLISHED or drawn[kind].tables.runs[column].nunique() > 1
        ]
        if len(parts) > 1:
            found.append(Plot(name, "", pd.concat(parts, ignore_index=True), grouped_figure))
    matrices = generalisation(released, [of.matrices for of in drawn.values()])
    if len(matrices):
        found.append(Plot("generalisation", "", matrices, generalization_figure))
    return found


def panels(tables: PublishedTables, released: PublishedTables) -> PublishedResults:
    """Return what the figures of the published results are drawn of, for any tables."""
    made = {
        "panel_a": panel_a(tables),
        "panel_c": panel_c(tables),
        "panel_d": panel_d(tables),
        "panel_e": panel_e(tables),
        "figure_s1": figure_s1(released),
        "figure_s3": figure_s3(released),
    }
    return PublishedResults(made, {"panels": SELECTION})


def interleaved(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of figures by kind of model, models of one name one below the other.

    Each panel has one line and one band of people: those of the first kind.
    """
    first = next(iter(tables.values()))
    parts = [
        table.assign(kind=kind, model=table["model"] + SUFFIXES[kind], base=table["model"])
        for kind, table in tables.items()
    ]
    table = pd.concat(parts, ignore_index=True)
    people = first.drop_duplicates("panel").set_index("panel")
    for name in ("people", "people_is", "zone_low", "zone_high", "zone"):
        table[name] = table["panel"].map(people[name])
    place = {name: at for at, name in enumerate([*SCENARIOS, MEAN])}
    rank = {name: at for at, name in enumerate(MODELS.values())}
    table = table.assign(
        place=table["panel"].map(place), rank=table["base"].map(rank).fillna(len(rank))
    )
    return table.sort_values(["place", "rank", "base"], kind="stable", ignore_index=True)


def generalisation(released: PublishedTables, own: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return accuracy less people's by training and tested scenario, published and own.

    Of *only* the released tables have the diagonal: no other scenario was tested.
    """
    known = [table for table in own if len(table)]
    if not known:
        return pd.DataFrame()
    ours = pd.concat(known, ignore_index=True)
    runs = averaged(released).runs
    runs = runs[runs["model"].isin(set(ours["model"])) & (runs["readout"] == SIMULATED)]
    people = released.people.set_index("scenario")["accuracy"]
    theirs = pd.DataFrame(
        {"model": runs["model"] + " (published)",
         "trained": runs["training"].where(runs["training"] != ONLY, runs["scenario"]),
         "tested": runs["scenario"], "stimuli": np.nan, "accuracy": runs["accuracy"],
         "people": runs["scenario"].map(people)}
    )  # fmt: skip
    theirs = theirs[theirs["tested"].isin(set(ours["tested"]))]
    theirs = theirs.assign(difference=theirs["accuracy"] - theirs["people"])
    table = pd.concat([ours.assign(model=ours["model"] + SUFFIXES[HERE]), theirs])
    order = {name: rank for rank, name in enumerate(["all", ALL_BUT, *SCENARIOS])}
    table = table.assign(row=table["trained"].map(order), column=table["tested"].map(order))
    return table.sort_values(["row", "column", "model"], ignore_index=True)


# The page.


def trainings(parts: Sequence[Stored]) -> pd.DataFrame:
    """Return how parts were trained; *one* has the trainings of *only*."""
    records = []
    for part in parts:
        count = len(part.losses)
        records.append(
            {"model": part.model, "protocol": part.protocol, "trials": part.scale["trials"],
             "trainings": count, "steps": part.steps, "of the default": part.scale["steps"],
             "held-out loss within 2 %": f"{part.steady} of {count}",
             "pictures": "rendered" if part.rendered else "from movies", "stored": part.made}
        )  # fmt: skip
    return pd.DataFrame(records)


def accuracies(tested: Mapping[str, Tested]) -> pd.DataFrame:
    """Return the mean accuracy over scenarios by model, training, readout and set."""
    keys = ["model", "training", "readout"]
    columns = {}
    for name, of in tested.items():
        across = of.across.runs
        runs = pd.concat([of.tables.runs, across[across["training"] == ANOTHER]])
        by_scenario = runs.groupby([*keys, "scenario"], sort=False)["accuracy"].mean()
        columns[SETS[name]] = by_scenario.groupby(keys, sort=False).mean()
    order = {name: at for at, name in enumerate([*MODELS.values(), "all", ALL_BUT, ONLY, ANOTHER,
                                                 "observed", SIMULATED, "full"])}  # fmt: skip
    table = pd.DataFrame(columns).rename_axis(keys).reset_index()
    table = table.sort_values(keys, key=lambda v: v.map(order).fillna(-1), kind="stable")
    for name in columns:
        table[name] = table[name].map("{:.3f}".format).replace("nan", "-")
    return table.rename(columns={"training": "trained on"})


def markdown(table: pd.DataFrame) -> str:
    """Return a table as Markdown."""
    return markdown_table(list(table.columns), table.astype(str).to_numpy().tolist())


CAPTIONS = {
    "panel_a": "**A.** Accuracy, trained on all scenarios, *observed+simulated*. Dashed: people; "
    "grey: the middle 95 % of participants; hatched: the paper's band. All three as published, for "
    "all stimuli of the study.",
    "panel_b": "**B.** r with the average person. The released tables do not determine the "
    "published one. Dashed: the noise ceiling. Without a number: undefined, since the answers are "
    "constant.",
    "panel_c": "**C.** Cohen's kappa with people: published, the median over participants; here, "
    "with a person drawn anew for each stimulus (the answers of single participants are not "
    "released).",
    "panel_d": "**D.** Accuracy by readout, trained on all scenarios. Dashed: people, on the same "
    "stimuli. Particle models have one readout.",
    "panel_e": "**E.** Accuracy by training protocol, *observed+simulated*. Dashed: people.",
    "generalisation": "Accuracy less people's: trained on (rows), tested on (columns). The "
    "released tables hold no training on another scenario than the tested one, so that of the "
    "published matrix only the diagonal is known.",
}
STORED_ABOUT = (
    "**Weights of the package.** The scores are those of [the page on models and people]"
    "(models.md#official-stimuli): {official} official stimuli with the readouts that ship "
    "([official_all.csv](../../benchmarks/results/official_all.csv)), fitted on 1,000 trials per "
    "scenario; and {own} own trials with "
    "readouts of 200 ([small.txt](../../benchmarks/results/small.txt)). These models have the size "
    "`small` and were trained on our own trials of all scenarios. On official stimuli they see "
    "frames 2, 8, ..., 44, and particle models decide by *end*, as in the paper; on own trials, "
    "which were tested before, frames 0, 6, ..., 36, under *full* frames up to 144, and *touch*."
)


def write_page(parts: Sequence[Stored], folder: Path, *, write: bool) -> str:
    """Return the page of what is stored; draw the figures into FOLDER/page.

    With ``write`` the page goes to `PAGE` and the pictures to `RESULTS`.
    """
    released = read_published(official().results.parent)
    tested = {"shipped_official": stored_official(released), "shipped_own": stored_own(released)}
    if parts:
        joined = pd.concat([part.predictions for part in parts], ignore_index=True)
        for name in TESTED:
            rows = joined[joined["tested"] == name].drop(columns="tested")
            if len(rows):  # none of own trials if only *one* is there
                tested[name] = tested_of(rows, released, people=name == "official")
    table = claims(released, tested)
    pictures = prepare_folder(folder / "page")
    write_csv(folder / "page" / "tables" / "claims.csv", table)
    plots = figures(released, tested)
    for plot in plots:
        write_plot(plot, pictures)
        if write:
            # Few colours, for a third of the bytes.
            drawn = Image.open(pictures / f"{plot.name}.png").convert("RGB").quantize(256)
            drawn.save(RESULTS / f"paper_{plot.name}.png", optimize=True)
    text = page_text(parts, tested, table, [plot.name for plot in plots])
    if write:
        PAGE.write_text(text)
    return text


def page_text(
    parts: Sequence[Stored], tested: Mapping[str, Tested], table: pd.DataFrame, drawn: Sequence[str]
) -> str:
    """Return the page as Markdown."""
    differ = []
    for _, row in table.iterrows():
        other = [name for name in tested if row[f"{name}_verdict"] in DIFFERENT]
        if other:
            ours = "; ".join(
                f"{SETS[name]}: {row[name]} (**{row[f'{name}_verdict']}**)" for name in other
            )
            differ.append(
                f"- *{row['claim']}*: {row['sentence']}. Compared: {row['compared']}. "
                f"Released tables: {row['released']}. {ours[0].upper()}{ours[1:]}."
            )
    shown = table[["claim", "compared", "published", "released"]].copy()
    shown["claim"] = "*" + table["claim"] + "*: " + table["sentence"]
    for name in tested:
        shown[SETS[name]] = [
            ours if of == NOT_COMPUTED else f"{ours} (**{of}**)"
            for ours, of in zip(table[name], table[f"{name}_verdict"], strict=True)
        ]
    known = {(part.model, part.protocol) for part in parts}
    missing = []
    for protocol in PROTOCOLS:
        able = [name for name in NAMES if name in GENERALISED or protocol != "one"]
        rest = [NAMES[name] for name in able if (name, protocol) not in known]
        if rest:
            missing.append(f"- *{protocol}*: {', '.join(rest)}")
    missing.append("- pVGG and pDeIT: their ImageNet weights cannot be had here")
    stored = {name: tested[f"shipped_{name}"].trials for name in ("official", "own")}
    lines = [
        "# Results: the paper's claims",
        "Are the claims of the paper's Results section true of models of this package? Each is "
        "tested as the paper tested it: accuracy by a mixed model, with random intercepts of "
        "scenario, readout and training. This page was written by",
        "",
        "```sh",
        "python benchmarks/models/paper_page.py --write",
        "```",
        "",
        f"{datetime.date.today()}, {processor()}. {STORED_ABOUT.format(**stored)}",
        "",
        _trained(parts, tested),
        "",
        "## What does not come out the same",
        "Claims whose test is significant (p < .05) in the released tables and here, with another "
        "sign, or in one of the two only. *Neither*: in none of the two, whatever the signs, which "
        "is what a claim of no difference says. *Not shown here* is no refutation: the models are "
        "small, and fewer. Rows of one model and scenario share their stimuli, which these tests "
        "do not know, so that their p are too small, there and here. Encoders of ImageNet are "
        "frozen: under *observed* and *full* their rows are the same with mlp and lstm and under "
        "all protocols, which makes differences of protocols smaller. Claims about people only are "
        "those of `physion compare --published`.",
        "",
        *(differ or ["Nothing of what was computed."]),
        "",
        *[_counted(SETS[name], table[f"{name}_verdict"]) for name in tested],
        "",
        "## Claims",
        "*Published*: as printed. *Released*: what the sentence asks for, from the released "
        "tables, each row once (`physion compare --published` has more). Then the same test on our "
        "models, which are named. In the place of pVGG and pDeIT stand encoders with weights of "
        "ImageNet that are here.",
        "",
        markdown(shown),
        "",
        "## Figure 4",
        "Official stimuli. Models that are missing were not computed.",
        "",
        *[line for name in drawn if name != "generalisation" for line in _picture(name)],
        *([] if "panel_e" in drawn else [f"**E.** Training protocols: {NOT_COMPUTED}.", ""]),
        "## Generalisation",
        *(_picture("generalisation") if "generalisation" in drawn else [f"{NOT_COMPUTED}.", ""]),
        "## Accuracies",
        "Means over scenarios, of seeds too.",
        "",
        markdown(accuracies(tested)),
        "",
        "## Not computed",
        *missing,
    ]
    return "\n".join(map(_wrapped, "\n".join(lines).split("\n"))) + "\n"


def _counted(name: str, verdicts: pd.Series) -> str:
    """Return how many claims come out the same, as a line of a list."""
    known = verdicts[verdicts.isin(["same", NEITHER, *DIFFERENT])]
    same, neither = (int((known == verdict).sum()) for verdict in ("same", NEITHER))
    return (
        f"- {name[0].upper()}{name[1:]}: {same} of {len(known)} claims come out the same, and "
        f"{neither} are significant in neither."
    )


def _wrapped(line: str) -> str:
    """Return a line of text in lines of at most 100 characters; tables and headings stay."""
    if line.startswith(("|", "#", "!", "python")):
        return line
    rest = "  " if line.startswith("- ") else ""
    return textwrap.fill(line, 100, subsequent_indent=rest, break_on_hyphens=False)


def _trained(parts: Sequence[Stored], tested: Mapping[str, Tested]) -> str:
    """Return what was trained for the page, with the table of trainings."""
    about = "**Trained for this page.** "
    if not parts:
        return f"{about}Nothing yet: `benchmarks/models/paper_table.py` does it, for days."
    counts = [f"{tested[name].trials} {name}" for name in TESTED if name in tested]
    return (
        f"{about}`python benchmarks/models/paper_table.py FOLDER --write`, with the scale, models "
        "and protocols of the table, stored their predictions in "
        "[results/paper](../../benchmarks/results/paper). The size is `small`. *Trials* are "
        "training trials per scenario (the paper: 2000), without labels; readouts were fitted on "
        f"{parts[0].scale['readout']} trials per scenario (the paper: 1000). Tested trials: "
        f"{', '.join(counts)}. Particle models have the decision *end*. *Held-out loss*: trainings "
        "in which it differs by at most 2 % from what it was after two thirds of the steps. *Of "
        "the default*: the fraction of steps that a model has by default. *one* has the trainings "
        "of *only*. Another processor rounds sums otherwise, and trains other weights: C-SWM and "
        "RPIN, trained by the same command on an Intel Xeon, are on this page of commit `511e26b9`."
        f"\n\n{markdown(trainings(parts))}"
    )


def _picture(name: str) -> list[str]:
    return [CAPTIONS[name], "", f"![{name}](../../benchmarks/results/paper_{name}.png)", ""]


def main() -> None:
    """Make the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true")
    chosen = parser.parse_args()
    with TemporaryDirectory() as folder:
        print(write_page(read_stored(), Path(folder), write=chosen.write))


if __name__ == "__main__":
    main()
