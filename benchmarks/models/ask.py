"""Speed of asking a language model, with the mock model of Inspect, and what simple answers score.

    python benchmarks/models/ask.py DATASET [--stimuli 1050] [--write]

Needs the extra 'inspect', so that it runs in the environment of Inspect. DATASET has testing trials
with movies, which are listed under new names until there are enough stimuli; nothing is remembered
of one for another. Each stimulus is asked about twice. Time is from the start of the task, with the
reading of the index, to the written log; Python's imports are left out.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import pandas as pd
from inspect_ai import eval as run_tasks
from inspect_ai.model import ModelOutput, ModelUsage, get_model

from physion.core.tables import markdown_table
from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths
from physion.trials.index import write_index

RESULT = Path(__file__).parents[1] / "results" / "ask.md"


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


def option(question: str, word: str) -> str:
    """The letter of an option."""
    found = re.search(rf"^([AB])\) {word}$", question, re.MULTILINE)
    assert found is not None
    return found[1]


def mock(answer: Any) -> Any:
    """A model that answers at once."""

    def outputs(messages: Any, *_: Any) -> ModelOutput:
        output = ModelOutput.from_content("mockllm", answer(messages[-1].content[-1].text))
        output.usage = ModelUsage(input_tokens=1, output_tokens=1, total_tokens=2)
        return output

    return get_model("mockllm/model", custom_outputs=outputs)


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


def main() -> None:
    """Run the mock models and print one row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--stimuli", type=int, default=1050)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        dataset = enlarged(options.dataset, Path(folder) / "trials", options.stimuli)
        rows = [row(dataset, *run, f"{folder}/logs") for run in RUNS]
    head = f"# Answers of the mock model\n`python benchmarks/models/ask.py` with {options.stimuli} "
    table = markdown_table(list(HEADINGS), rows)
    text = f"{head}stimuli, {date.today().isoformat()}\n\n{table}\n"
    print(text)
    if options.write:
        RESULT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
