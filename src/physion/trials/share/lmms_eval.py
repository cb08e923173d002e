"""Export of a question task for lmms-eval: two tasks, their items and movies, without a download.

A folder holds ``physion_contact.yaml`` and ``physion_perception.yaml``, a parquet file of items for
each, ``utils.py`` and ``movies/``. ``utils.py`` begins with the text of
`physion.trials.share.questions`, so that questions, reading of answers and measures are the same
for every harness. The samples that lmms-eval logs are read by `physion.tasks.logs`.
"""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import digest_of, folder_for_writing, remove_leftovers, write_atomic
from physion.trials.dataset import Dataset
from physion.trials.share import questions
from physion.trials.share.items import Item, items_of, movie_of
from physion.trials.share.questions import VERSION

TASKS = {"contact": False, "perception": True}
"""Tasks, and whether they are the control."""
METRICS = {
    "contact": ("accuracy", "d_prime", "yes_bias", "flips", "unreadable", "asked"),
    "perception": ("accuracy", "flips", "unreadable", "asked"),
}
"""Metrics by task; ``asked``, the number of questions, carries the item into the log."""
_YAML = """\
task: physion_{task}
# A folder that was moved needs its new path here.
dataset_path: parquet
dataset_kwargs:
  data_files:
    test: {items}
test_split: test
output_type: generate_until
process_docs: !function utils.with_movies
doc_to_visual: !function utils.visual
doc_to_text: !function utils.question
doc_to_target: !function utils.target
process_results: !function utils.results_of_{task}
metric_list:
{metrics}
generation_kwargs:
  max_new_tokens: 16
  temperature: 0
  do_sample: false
lmms_eval_specific_kwargs:
  default:
    wording: 1
metadata:
  version: {version}
"""
_METRIC = """\
  - metric: {name}
    aggregation: !function utils.{name}
    higher_is_better: {better}"""
_SCRIPT = '''

# --- task of lmms-eval ----------------------------------------------------------------------------

import hashlib  # noqa: E402
from pathlib import Path  # noqa: E402

FOLDER = Path(__file__).parent


def with_movies(items):
    """Return the items; raise an error if a movie is missing or was changed: no score without."""
    for movie, sha256 in sorted(set(zip(items["movie"], items["sha256"]))):
        path = FOLDER / movie
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing: export the task again")
        if hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
            raise ValueError(f"{path} was changed: export the task again")
    return items


def visual(item):
    return [str(FOLDER / item["movie"])]


def question(item, lmms_eval_specific_kwargs=None):
    wording = (lmms_eval_specific_kwargs or {}).get("wording", 1)
    return prompt(item["question"], item["order"], wording)


def target(item):
    return LETTERS[options_of(item["question"], item["order"]).index(item["truth"])]


def _results(item, texts, names):
    options = options_of(item["question"], item["order"])
    answer = read_answer(texts[0] if texts else "", options)
    stimulus = item["trial"] + " " + item["question"]
    found = list(judged(stimulus, item["question"], item["truth"], answer))
    return {name: dict(item) if name == "asked" else found for name in names}


def _measure(name):
    return lambda rows: measures(JudgedAnswer(*row) for row in rows)[name]


asked = len
'''
_README = """\
# Physion for lmms-eval: {count} stimuli
    lmms-eval --include_path {folder} --tasks physion_contact --model MODEL --log_samples \\
        --output_path logs
    physion compare logs/*/*_samples_physion_contact.jsonl

Everything is in this folder: nothing is downloaded. `physion_contact` asks whether red will touch
yellow, `physion_perception` what is shown, as a control. Each question is asked twice, with its
options in both orders. `wording` in the yaml files chooses one of the {wordings} wordings. A movie
that is missing or was changed is an error: nothing is scored.
"""


def export_lmms_eval(
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    verify: bool = True,
    progress: Progress | None = None,
) -> list[Path]:
    """Write a question task for lmms-eval into ``out``; return its yaml files and the README.

    Parameters
    ----------
    folder, out
        Folder of the dataset, and folder to write into.
    split, scenario
        Trials; by default all of the split testing.
    verify
        Compare movies with their SHA-256 in the index.
    progress
        Called after every movie.

    Raises
    ------
    UnknownNameError
        For an unknown split or scenario.
    BadInputError
        For a trial that cannot be asked about (see `items_of`), or if no question is left.
    """
    dataset, where = Dataset(folder, verify=verify), out.resolve()
    items = {
        task: items_of(dataset, split=split or "testing", scenario=scenario, control=control)
        for task, control in TASKS.items()
    }
    if not items["contact"]:
        raise BadInputError(f"{folder} has no trial to ask about")
    movies = {_movie(item): item for group in items.values() for item in group}
    with folder_for_writing(out):
        remove_leftovers(out)
        (out / "movies").mkdir(exist_ok=True)
        digests = {}
        for name, item in tracked(list(movies.items()), "movies", len(movies), progress):
            content = movie_of(dataset, item)
            digests[name] = digest_of(content)
            write_atomic(out / name, content)
        made = {"README.md": _README.format(
            count=len({item.trial for item in items["contact"]}), folder=where,
            wordings=len(questions.WORDINGS),
        )}  # fmt: skip
        functions = ""
        for task, group in items.items():
            write_atomic(out / f"{task}.parquet", _table(group, digests))
            metrics = [
                _METRIC.format(name=name, better=str(name in ("accuracy", "d_prime")).lower())
                for name in METRICS[task]
            ]
            made[f"physion_{task}.yaml"] = _YAML.format(
                task=task, items=json.dumps(str(where / f"{task}.parquet")),
                metrics="\n".join(metrics), version=VERSION,
            )  # fmt: skip
            functions += (
                f"\ndef results_of_{task}(item, texts):\n"
                f"    return _results(item, texts, {METRICS[task]!r})\n\n"
            )
        functions += "".join(f"\n{name} = _measure({name!r})" for name in METRICS["contact"][:-1])
        source = Path(questions.__file__).read_text(encoding="utf-8")
        write_atomic(out / "utils.py", f"{source}{_SCRIPT}{functions}\n".encode())
        for name, text in made.items():
            write_atomic(out / name, text.encode())
    return [out / name for name in made]


def _movie(item: Item) -> str:
    """Return the path of an item's movie in the folder."""
    return f"movies/{item.trial}{'' if item.shown == 'observed' else '_' + item.shown}.mp4"


def _table(items: list[Item], digests: dict[str, str]) -> bytes:
    """Return the items as a parquet file."""
    rows = [
        {
            "id": item.id,
            "trial": item.trial,
            "scenario": item.scenario,
            "question": item.question,
            "truth": item.truth,
            "order": item.order,
            "movie": _movie(item),
            "sha256": digests[_movie(item)],
            "version": VERSION,
        }
        for item in items
    ]
    sink = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(rows), sink)
    return bytes(sink.getvalue())
