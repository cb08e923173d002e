"""Run the tasks of Inspect with its mock model; started by a test with Inspect's own Python.

`python inspect_runs.py DATASET LOGS`: prints one JSON object, results by name of the run.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
from inspect_ai import eval as run_tasks
from inspect_ai import eval_retry
from inspect_ai.log import read_eval_log, write_eval_log
from inspect_ai.model import ModelOutput, ModelUsage, get_model

from physion.core.errors import PhysionError
from physion.tasks.inspect import _data_uri as data_uri
from physion.tasks.logs import read_answers
from physion.trials.dataset import Dataset
from physion.trials.share.items import items_of, movie_of

SLOW = "slow"
"""Answer that comes after a minute."""


def option(question: str, word: str) -> str:
    """The letter of an option in a question."""
    return next(line[0] for line in question.splitlines() if line[1:] == f") {word}")


def mock(answer: Callable[[str, int], str]) -> Any:
    """A model that answers by the question, and by the number of pictures before it."""

    async def outputs(messages: Any, *_: Any) -> ModelOutput:
        *pictures, text = messages[-1].content
        said = answer(text.text, len(pictures))
        if said == SLOW:
            await anyio.sleep(60)
        output = ModelOutput.from_content("mockllm", said)
        # Otherwise Inspect counts tokens, with a file that it downloads.
        output.usage = ModelUsage(input_tokens=1, output_tokens=1, total_tokens=2)
        return output

    return get_model("mockllm/model", custom_outputs=outputs)


def truths(dataset: str) -> dict[str, str]:
    """The right answer by the movie that is shown, as Inspect hands it to a model."""
    known = Dataset(dataset)
    return {data_uri("video/mp4", movie_of(known, item)): item.truth for item in items_of(known)}


def knows(by_movie: dict[str, str]) -> Any:
    """A model that finds the outcome by the movie before the question."""

    async def outputs(messages: Any, *_: Any) -> ModelOutput:
        movie, text = messages[-1].content
        said = option(text.text, by_movie[movie.video])
        output = ModelOutput.from_content("mockllm", f"I think so. Answer: {said}")
        output.usage = ModelUsage(input_tokens=1, output_tokens=1, total_tokens=2)
        return output

    return get_model("mockllm/model", custom_outputs=outputs)


def results(log: Any) -> dict[str, Any]:
    """All metrics of a log by name, and its status."""
    found = {name: one.value for score in log.results.scores for name, one in score.metrics.items()}
    return {"status": log.status, **found}


def predictions(path: Path) -> dict[str, Any]:
    """What `compare` reads of a log."""
    try:
        log = read_answers(path)
    except PhysionError as error:
        return {"error": str(error)}
    rows = {row.pop("stimulus"): row for row in log.predictions.to_dict("records")}
    return {"rows": rows, "warnings": list(log.warnings)}


def main(dataset: str, folder: str) -> None:
    """Run the mock models and print what came out."""
    logs, found = Path(folder), dict[str, Any]()

    def run(name: str, answer: Any, **options: Any) -> Any:
        task = options.pop("task", "physion/contact")
        arguments = {"dataset": dataset, **options.pop("arguments", {})}
        model = answer if name == "truth" else mock(answer)
        log = run_tasks(task, model, task_args=arguments, log_dir=str(logs / name),
                        display="none", **options)[0]  # fmt: skip
        if log.results:
            found[name] = results(log)
        return log

    run("yes", lambda text, _: option(text, "yes"))
    run("no", lambda text, _: f"The answer is {option(text, 'no')}) no.")
    run("truth", knows(truths(dataset)), arguments={"media": "movie"})
    run("first", lambda *_: "A", arguments={"media": "movie", "wording": 3})
    run("nonsense", lambda *_: "I cannot answer yes or no to this.")
    run("pictures", lambda text, count: "A" if count == 3 and "These 3 pictures" in text else "",
        arguments={"frames": 3})  # fmt: skip
    seen = run("seen", lambda text, _: "A", task="physion/perception")
    found["questions"] = sorted({sample.metadata["question"] for sample in seen.samples})
    run("slow", lambda *_: SLOW, time_limit=1, limit=2)

    # A log of which half is missing, and the same after the missing answers were made.
    asked = iter(range(100))

    def breaks(text: str, _: int) -> str:
        if next(asked) >= 4:
            raise ConnectionError("no such host")
        return option(text, "yes")

    log = run("broken", breaks, max_connections=1, max_samples=1)
    found["half"] = predictions(Path(log.location))
    # The mock model of the command line counts tokens and so fails without a network.
    retried = eval_retry(log, log_dir=str(logs / "retried"), display="none")[0]
    kept = [sample for sample in retried.samples if sample.output.completion in ("A", "B")]
    found["retried"] = {"task": retried.eval.task, "kept": len(kept)}
    asked = iter(range(100))
    twice = run("twice", breaks, epochs=2, fail_on_error=False, max_connections=1, max_samples=1)
    found["epochs"] = predictions(Path(twice.location))
    whole = next((logs / "yes").glob("*.eval"))
    found["read"] = predictions(whole)
    found["true"] = predictions(next((logs / "truth").glob("*.eval")))
    found["order"] = predictions(next((logs / "first").glob("*.eval")))
    found["other question"] = predictions(next((logs / "seen").glob("*.eval")))
    cut = logs / "cut.eval"
    cut.write_bytes(whole.read_bytes()[:3000])
    found["cut"] = predictions(cut)
    older = read_eval_log(str(whole))
    older.eval.metadata["physion"] = 0
    write_eval_log(older, str(logs / "older.json"))
    found["older"] = predictions(logs / "older.json")
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
