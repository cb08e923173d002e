"""How often 95 % intervals of the analysis contain what they are about.

    python benchmarks/analysis/interval_coverage.py [--repeats 800] [--size 40x60 100x150]
        [--only TEXT ...] [--population even|rare] [--write]

Studies are simulated again and again (`coverage_studies`), and intervals are computed by the
package's own functions: scores of models, and differences between them
(`coverage_models`); people, hypotheses and mixed models (`coverage_people`). Not
simulated are those of the published tables. An interval is about the expected value of the number
with other people, other stimuli, or both, of the same number; that value is the mean over all
repeats. Coverage is the fraction of repeats whose interval
contains it. Its standard error is 0.6 % with 1200 repeats; for means over eight scenarios, which
are groups of repeats drawn at random, up to 1.8 %. What takes long has fewer repeats (column
``repeats``): numbers about people, hypotheses, mixed models and pooled scenarios.
"""

from __future__ import annotations

import argparse
import datetime
import time
from pathlib import Path

import pandas as pd

from coverage_models import measures, of_stimuli, pooled, rollout_errors
from coverage_people import hypotheses, mixed_models, of_people
from coverage_studies import MODELS, POPULATIONS, Coverage
from physion.analysis.sample import RESAMPLED
from physion.compute.tasks import processor

RESULTS = Path(__file__).parents[1] / "results" / "interval_coverage.md"
SIZES = ((40, 60), (100, 150))
BOUNDS = (93, 97)
"""Per cent of repeats that the interval should contain the value in."""


def markdown(table: pd.DataFrame, seconds: float, command: str) -> str:
    """The table as text: a summary by number, then every interval outside 93 to 97 %."""
    outside = table[~table["inside"].between(*BOUNDS)]
    is_mean = table["what"].str.startswith("mean of 8")
    groups = (("of single numbers", ~is_mean), ("of means of 8", is_mean))
    counted = "; ".join(_counted(table[chosen], what) for what, chosen in groups if chosen.any())
    lines = [
        f"## {datetime.date.today()}, {processor()}, `{command}`",
        "",
        f"{len(table)} intervals, {seconds:.0f} s of processor. {counted}.",
        "",
        "| number | intervals | lowest % | mean % | highest % | outside 93 to 97 % |",
        "|---|---|---|---|---|---|",
    ]
    for name, rows in table.groupby(table["what"].map(_number), sort=False):
        inside = rows["inside"]
        lines.append(
            f"| {name} | {len(rows)} | {inside.min():.1f} | {inside.mean():.1f} | "
            f"{inside.max():.1f} | {int((~inside.between(*BOUNDS)).sum())} |"
        )
    head = ["number", "drawn", "people x stimuli", "repeats", "mean value", "mean width",
            "inside %", "interval below %", "interval above %", "undefined"]  # fmt: skip
    lines += ["", "### Outside 93 to 97 %", "", "| " + " | ".join(head) + " |",
              "|" + "---|" * len(head)]  # fmt: skip
    lines += [
        f"| {row['what']} | {row['drawn']} | {row['size']} | {row['repeats']} | "
        f"{row['value']:.3f} | {row['width']:.3f} | {row['inside']:.1f} | {row['below']:.1f} | "
        f"{row['above']:.1f} | {row['undefined']} |"
        for row in outside.to_dict("records")
    ]
    return "\n".join(lines) + "\n"


def _counted(table: pd.DataFrame, what: str) -> str:
    inside = table["inside"]
    good = int(inside.between(*BOUNDS).sum())
    return (
        f"{good} of the {len(table)} {what} contain the expected value in 93 to 97 % of repeats "
        f"(all: {inside.min():.1f} to {inside.max():.1f} %, mean {inside.mean():.1f} %)"
    )


def _number(what: str) -> str:
    """The name without the model, and whether it is a mean or a difference."""
    mean = what.startswith("mean of 8: ")
    model, _, name = what.removeprefix("mean of 8: ").rpartition(": ")
    if " less " in model:
        name = f"difference of {name}" + (", pooled" if model.startswith("pooled") else "")
    elif model not in (*MODELS, "two people"):
        name = what.removeprefix("mean of 8: ")
    return f"{name}, mean of 8" if mean else name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=800)
    sizes = [f"{people}x{stimuli}" for people, stimuli in SIZES]
    parser.add_argument("--size", nargs="+", default=sizes, help="people x stimuli")
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT",
                        help="only intervals whose name contains one of these texts")  # fmt: skip
    parser.add_argument("--population", choices=POPULATIONS, default="even")
    parser.add_argument("--write", action="store_true", help="write results/interval_coverage.md")
    options = parser.parse_args()
    coverage, began = Coverage(options.only, options.population), time.process_time()
    repeats = options.repeats

    def done(what: str) -> None:
        print(f"{what}: {time.process_time() - began:.0f} s", flush=True)

    for size in [(int(n), int(s)) for n, s in (text.split("x") for text in options.size)]:
        for drawn in RESAMPLED:
            measures(coverage, drawn, size, repeats)
            done(f"measures, {drawn} drawn, {size}")
        of_stimuli(coverage, size, repeats)
        done(f"differences, {size}")
        of_people(coverage, size, repeats // 2)
        done(f"of_people, {size}")
        for slow in (rollout_errors, hypotheses):
            slow(coverage, size, repeats // 4)
            done(f"{slow.__name__}, {size}")
        mixed_models(coverage, size, repeats // 8)
        done(f"mixed models, {size}")
    pooled(coverage, SIZES[0], repeats // 4)
    command = f"python benchmarks/analysis/interval_coverage.py --repeats {repeats}"
    command += f" --size {' '.join(options.size)} --population {options.population}"
    command += f" --only {' '.join(map(repr, options.only))}" if options.only else ""
    table = coverage.table()
    text = markdown(table, time.process_time() - began, command)
    print(text)
    if options.write:
        table.round(4).to_csv(RESULTS.with_suffix(".csv"), index=False, lineterminator="\n")
        RESULTS.write_text(
            "# Coverage of the intervals\n\nWhat is simulated: "
            "`benchmarks/analysis/interval_coverage.py`. "
            "Every interval: `interval_coverage.csv`.\n\n" + text
        )


if __name__ == "__main__":
    main()
