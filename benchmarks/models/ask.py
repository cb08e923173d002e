"""Speed of asking a language model, with the mock model of Inspect, and what simple answers score.

    python benchmarks/models/ask.py DATASET [--stimuli 1050] [--write]
    python benchmarks/models/ask.py OFFICIAL --people 10 [--write]

The second form compares the answers with people: OFFICIAL has official trials, of which ten of each
scenario are asked about, without a contact in the observed part, whose simulated outcome is the
recorded one. Their movies are rendered. A model that always says yes, one that always says no, and
one that knows the outcome are compared with people by `physion compare`.

Needs the extra 'inspect', so that it runs in the environment of Inspect. DATASET has testing trials
with movies, which are listed under new names until there are enough stimuli; nothing is remembered
of one for another. Each stimulus is asked about twice. Time is from the start of the task, with the
reading of the index, to the written log; Python's imports are left out.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import re
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import pandas as pd
from inspect_ai import eval as run_tasks
from inspect_ai.model import ModelOutput, ModelUsage, get_model

import physion
from physion.analysis.tables import POOLED
from physion.core.tables import markdown_table
from physion.data.official import official
from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths
from physion.trials.index import write_index
from physion.trials.share.items import Item, items_of, movie_of
from physion.trials.share.questions import CONTACT

RESULTS = Path(__file__).parents[1] / "results"


def enlarged(folder: Path, out: Path, count: int) -> Dataset:
    """A dataset of ``count`` stimuli; its movies are links to those of the one in ``folder``."""
    known = Dataset(folder)
    rows = known.index[known.index["split"] == "testing"].to_dict("records")
    made = []
    for place in range(count):
        row = dict(rows[place % len(rows)])
        name = f"{row['trial']}-{place // len(rows)}"
        paths = TrialPaths(out, row["split"], row["scenario"], name)
        paths.observed_movie.parent.mkdir(parents=True, exist_ok=True)
        old = known.paths(str(row["trial"])).observed_movie
        paths.observed_movie.symlink_to(old.resolve())
        made.append({**row, "trial": name})
    write_index(out, pd.DataFrame(made).astype(known.index.dtypes.to_dict()))
    return Dataset(out)


def with_movies(folder: Path, out: Path, each: int) -> Dataset:
    """``each`` official trials of every scenario with observed movies, half of them with contact.

    The index says of the observed movie what was made; other files are links.
    """
    known, people = Dataset(folder), set(official().labels)
    index = known.index[known.index["split"] == "testing"]
    agree = index["recorded_contact"].isna() | index["recorded_contact"].eq(index["contact"])
    index = index[index["trial"].isin(people) & agree & ~index["observed_contact"]]
    made = []
    for (scenario, contact), rows in index.groupby(["scenario", "contact"]):
        count = each // 2 + (each % 2 if contact else 0)
        for row in rows.sort_values("trial").head(count).to_dict("records"):
            trial = str(row["trial"])
            paths = TrialPaths(out, "testing", str(scenario), trial)
            paths.trial_file.parent.mkdir(parents=True, exist_ok=True)
            paths.trial_file.symlink_to(known.paths(trial).trial_file.resolve())
            movie = movie_of(known, Item(trial, str(scenario), CONTACT, "", 0))
            paths.observed_movie.write_bytes(movie)
            row |= {
                "look": "redyellow",
                "observed_movie": str(paths.observed_movie.relative_to(out)),
                "observed_movie_bytes": len(movie),
                "observed_movie_sha256": hashlib.sha256(movie).hexdigest(),
            }
            made.append(row)
    write_index(out, pd.DataFrame(made).astype(known.index.dtypes.to_dict()))
    return Dataset(out)


def option(question: str, word: str) -> str:
    """The letter of an option."""
    found = re.search(rf"^([AB])\) {word}$", question, re.MULTILINE)
    assert found is not None
    return found[1]


def mock(answer: Any, name: str = "model") -> Any:
    """A model that answers at once."""

    def outputs(messages: Any, *_: Any) -> ModelOutput:
        output = ModelOutput.from_content("mockllm", answer(messages[-1].content[-1].text))
        output.usage = ModelUsage(input_tokens=1, output_tokens=1, total_tokens=2)
        return output

    return get_model(f"mockllm/{name}", custom_outputs=outputs)


ANSWERS: dict[str, Any] = {
    "yes": lambda text: option(text, "yes"),
    "no": lambda text: option(text, "no"),
    "the first option": lambda text: "A",
    "a text without an option": lambda text: "It depends.",
}
HEADINGS = ("always answers", "shown", "accuracy", "standard error", "d'", "yes bias", "flips",
            "unreadable", "items/s", "processor ms an item")  # fmt: skip
RUNS = [("yes", "frames"), *((name, "movie") for name in ANSWERS)]


def row(dataset: Dataset, answer: str, media: str, logs: str) -> list[str]:
    """Run one mock model; return the cells of its row."""
    started, used = time.perf_counter(), time.process_time()
    (log,) = run_tasks(
        "physion/contact", mock(ANSWERS[answer]), log_dir=logs, display="none",
        task_args={"dataset": str(dataset.folder), "media": media},
    )  # fmt: skip
    seconds, used = time.perf_counter() - started, time.process_time() - used
    assert log.status == "success" and log.results is not None, log.error
    got = {n: m.value for score in log.results.scores for n, m in score.metrics.items()}
    values = [got[key] for key in ("accuracy", "stderr", "d_prime", "yes_bias", "flips")]
    items = 2 * len(dataset)
    shown = "8 pictures" if media == "frames" else "movie"
    numbers = (f"{got['unreadable']:.0f}", f"{items / seconds:.1f}", f"{1000 * used / items:.0f}")
    return [answer, shown, *(f"{value:.3f}" for value in values), *numbers]


def knows(dataset: Dataset) -> Any:
    """A model that knows the outcome by the movie that it is shown."""
    by_movie = {movie_of(dataset, item): item.truth for item in items_of(dataset)}

    def outputs(messages: Any, *_: Any) -> ModelOutput:
        movie, text = messages[-1].content
        shown = base64.b64decode(movie.video.partition(",")[2])
        output = ModelOutput.from_content("mockllm", option(text.text, by_movie[shown]))
        output.usage = ModelUsage(input_tokens=1, output_tokens=1, total_tokens=2)
        return output

    return get_model("mockllm/the-truth", custom_outputs=outputs)


MEASURES = {
    "accuracy": "accuracy",
    "r": "r with people",
    "kappa_from_averages": "kappa with people",
    "r_beyond_outcome": "r beyond the outcome",
    "kappa_beyond_outcome": "kappa beyond the outcome",
}


def beside_people(folder: Path, each: int, temporary: Path) -> str:
    """Ask about official stimuli, compare with people, and return the table."""
    dataset = with_movies(folder, temporary / "trials", each)
    models = {name: mock(ANSWERS[name], name) for name in ("yes", "no")}
    models["the truth"] = knows(dataset)
    cells: list[list[str]] = []
    for name, model in models.items():
        (log,) = run_tasks(
            "physion/contact", model, log_dir=str(temporary / "logs"), display="none",
            task_args={"dataset": str(dataset.folder), "media": "movie"},
        )  # fmt: skip
        assert log.status == "success", log.error
        scores = physion.compare(log.location.removeprefix("file://")).scores
        pooled = scores[scores["scenario"] == POOLED].set_index("kind")
        if not cells:
            cells.append(_cells("people", pooled.loc["people"]))
        cells.append(_cells(f"always {name}" if name != "the truth" else name, pooled.loc["model"]))
    table = markdown_table(["model", "stimuli", *MEASURES.values()], cells)
    head = (
        "# Answers of the mock model compared with people\n`python benchmarks/models/ask.py "
        f"OFFICIAL --people {each}`, {date.today().isoformat()}: {len(dataset)} official stimuli\n"
    )
    return f"{head}\n{table}\n"


def _cells(name: str, row: pd.Series) -> list[str]:
    """A row of the table: measures with their 95 % intervals, over all stimuli."""
    cells = [name, str(int(row["stimuli"]))]
    for measure in MEASURES:
        ends = ("", "_low", "_high")
        value, low, high = (round(row[f"{measure}{end}"], 3) + 0.0 for end in ends)  # no -0
        interval = "" if low != low else f" [{low:.3f}, {high:.3f}]"
        cells.append("-" if value != value else f"{value:.3f}{interval}")
    return cells


def main() -> None:
    """Run the mock models and print one row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--stimuli", type=int, default=1050)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--people", type=int, metavar="EACH")
    options = parser.parse_args()
    if options.people:
        with tempfile.TemporaryDirectory() as folder:
            text = beside_people(options.dataset, options.people, Path(folder))
        print(text)
        if options.write:
            (RESULTS / "ask_people.md").write_text(text, encoding="utf-8")
        return
    with tempfile.TemporaryDirectory() as folder:
        dataset = enlarged(options.dataset, Path(folder) / "trials", options.stimuli)
        rows = [row(dataset, *run, f"{folder}/logs") for run in RUNS]
    head = f"# Answers of the mock model\n`python benchmarks/models/ask.py` with {options.stimuli} "
    table = markdown_table(list(HEADINGS), rows)
    text = f"{head}stimuli, {date.today().isoformat()}\n\n{table}\n"
    print(text)
    if options.write:
        (RESULTS / "ask.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
