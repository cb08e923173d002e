"""Questions for language models: items, reading of answers, measures, export and logs."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import physion
from physion.analysis.statistics.agreement import z_rates
from physion.cli.main import main as cli
from physion.core.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.tasks.logs import read_answers
from physion.trials.dataset import Dataset
from physion.trials.share.items import Item, frames_of, items_of, movie_of
from physion.trials.share.questions import (
    JudgedAnswer,
    item_id,
    judged,
    measures,
    options_of,
    prompt,
    read_answer,
)
from physion.trials.video import read_frames
from support.red_and_yellow import OBSERVED, make_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return Dataset(make_dataset(tmp_path_factory.mktemp("squares")))


@pytest.fixture(scope="module")
def exported(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lmms")
    assert cli(["export", str(dataset.folder), str(out), "--layout", "lmms-eval"]) == 0
    return out


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("A", "yes"), ("B", "no"), ("(B)", "no"), ("**A**", "yes"), ("B.", "no"),
        ("A) yes", "yes"), ("yes", "yes"), ("No, they stay apart.", "no"), ("Yes.", "yes"),
        ("The red one falls.\nIt rolls on.\nAnswer: B", "no"), ("My answer is (A).", "yes"),
        ("First I thought the answer is A. But the final answer is B) no", "no"),
        ("Both roll.\nB", "no"), ("`B`", "no"), ("answer: yes", "yes"),
        ("", ""), ("A) no", ""), ("A or B", ""), ("yes or no", ""), ("Default output", ""),
        ("I cannot answer yes or no to this.", ""), ("A red object is in view.", ""),
        ("I have no idea", ""), ("C", ""), ("yes, but also no", ""), ("A\nB", ""),
    ],
)  # fmt: skip
def test_answers_are_read_by_rule(text: str, answer: str) -> None:
    assert read_answer(text, ("yes", "no")) == answer
    swapped = {"yes": "no", "no": "yes"}
    if answer and not {"yes", "no"} & set(text.lower().replace(",", " ").replace(".", " ").split()):
        assert read_answer(text, ("no", "yes")) == swapped[answer], "letters go with the order"


def test_measures_are_as_in_the_analysis() -> None:
    rng = np.random.default_rng(3)
    contact, said = rng.random(40) < 0.4, rng.random(40) < 0.6
    words = np.array(["no", "yes"])
    rows = [
        judged(f"s{place}", "contact", words[int(truth)], words[int(yes)])
        for place, (truth, yes) in enumerate(zip(contact, said, strict=True))
    ]
    got = measures(rows)
    hits, alarms = z_rates(said[None].astype(float), contact.astype(float), np.ones((1, 40)))
    assert got["d_prime"] == pytest.approx(float((hits - alarms)[0, 0]))
    assert got["accuracy"] == np.mean(contact == said)
    assert got["yes_bias"] == pytest.approx(said.mean() - contact.mean())


def test_unreadable_answers_are_never_right() -> None:
    rows = [judged("a", "contact", "yes", ""), judged("a", "contact", "yes", "yes"),
            judged("b", "contact", "no", ""), judged("c", "contact", "no", "no"),
            judged("c", "contact", "no", "yes")]  # fmt: skip
    got = measures(rows)
    assert (got["accuracy"], got["unreadable"], got["flips"]) == (0.4, 2, 1)
    assert got["yes_bias"] == pytest.approx(2 / 3 - 1 / 3), "of what can be read"
    assert measures([])["accuracy"] != measures([])["accuracy"], "NaN"


def test_items_ask_in_both_orders(dataset: Dataset) -> None:
    items = items_of(dataset)
    assert [(item.trial, item.order, item.truth) for item in items[2:6]] == [
        ("squares_1", 0, "yes"), ("squares_1", 1, "yes"),
        ("squares_2", 0, "no"), ("squares_2", 1, "no"),
    ]  # fmt: skip
    first, second = (prompt("contact", order).splitlines() for order in (0, 1))
    assert first[2:4] == ["A) yes", "B) no"] and second[2:4] == ["A) no", "B) yes"]
    assert first[:2] == second[:2]
    assert first[-1] == "Answer with the letter of one option only."
    assert len({prompt("contact", 0, wording) for wording in (1, 2, 3)}) == 3


def test_the_control_asks_what_is_shown(dataset: Dataset) -> None:
    items = items_of(dataset, control=True)
    left = {item.trial: item.truth for item in items if item.question == "left"}
    assert left == {f"squares_{k}": "yellow" if k % 2 else "red" for k in range(4)}
    for item in items:
        frames = frames_of(dataset, item, 5)
        coloured = (np.ptp(frames.astype(int), axis=-1) > 100).any()
        moves = (np.abs(np.diff(frames.astype(int), axis=0)) > 60).any()
        if item.question == "view":
            assert coloured == (item.truth == "yes")
        if item.question == "moves":
            assert moves == (item.truth == "yes")
    shown = {(item.question, item.truth) for item in items}
    assert {("view", "no"), ("view", "yes"), ("moves", "no"), ("moves", "yes")} <= shown


def test_pictures_are_of_the_observed_part_only(dataset: Dataset, tmp_path: Path) -> None:
    item = items_of(dataset)[0]
    path = dataset.paths(item.trial).observed_movie
    whole = read_frames(path)
    np.testing.assert_array_equal(frames_of(dataset, item, 3), whole[[0, 22, 44]])
    assert movie_of(dataset, item) == path.read_bytes()
    still = tmp_path / "still.mp4"
    still.write_bytes(movie_of(dataset, Item(item.trial, "", "moves", "no", 0, "still")))
    assert len(read_frames(still)) == OBSERVED


def test_trials_without_movies_in_red_and_yellow_are_rendered(
    dataset: Dataset, tmp_path: Path
) -> None:
    free = Dataset(make_dataset(tmp_path / "free", 2, look="free"))
    (item, *_) = items_of(free)
    opened = free.trial(item.trial)
    wanted = [opened.render(frame, look="redyellow").color for frame in (0, 44)]
    np.testing.assert_array_equal(frames_of(free, item, 2), np.stack(wanted))
    assert len(movie_of(free, item)) > 1000
    with pytest.raises(UnknownNameError, match="unknown split 'readout'"):
        items_of(free, split="readout")


def _functions(folder: Path) -> Any:
    """The functions of the exported task, loaded as lmms-eval loads them."""
    spec = importlib.util.spec_from_file_location("exported_task", folder / "utils.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_exported_task_asks_and_scores_like_the_package(exported: Path) -> None:
    task, items = _functions(exported), pd.read_parquet(exported / "contact.parquet")
    rows = items.to_dict("records")
    assert len(rows) == 8 and task.with_movies(items) is items
    assert all(Path(task.visual(row)[0]).is_file() for row in rows)
    text = task.question(rows[1], {"wording": 2})
    assert text == prompt("contact", 1, 2) and task.target(rows[1]) == "B"
    answers = {"yes": lambda row: row["truth"], "no": lambda row: "no", "": lambda row: "?"}
    for name, accuracy in (("yes", 1), ("no", 0.5), ("", 0)):
        given = [task.results_of_contact(row, [answers[name](row)]) for row in rows]
        assert task.accuracy([one["accuracy"] for one in given]) == accuracy
        assert task.asked([one["asked"] for one in given]) == 8
        assert task.unreadable([one["unreadable"] for one in given]) == (0 if name else 8)
    seen = pd.read_parquet(exported / "perception.parquet").to_dict("records")
    assert {row["movie"].rpartition("_")[2] for row in seen} >= {"grey.mp4", "still.mp4"}


def test_the_exported_task_refuses_missing_movies(exported: Path) -> None:
    task, items = _functions(exported), pd.read_parquet(exported / "contact.parquet")
    movie = exported / "movies" / "squares_2.mp4"
    content = movie.read_bytes()
    try:
        movie.write_bytes(content[:-1])
        with pytest.raises(ValueError, match="was changed"):
            task.with_movies(items)
        movie.unlink()
        with pytest.raises(FileNotFoundError, match=r"squares_2\.mp4 is missing"):
            task.with_movies(items)
    finally:
        movie.write_bytes(content)


def _samples(folder: Path, exported: Path, answer: str) -> Path:
    """A log as lmms-eval 0.7 writes it, with one answer to all questions."""
    task, lines = _functions(exported), []
    for row in pd.read_parquet(exported / "contact.parquet").to_dict("records"):
        scored = task.results_of_contact(row, [answer])
        lines.append(json.dumps({"doc_id": 0, "filtered_resps": answer, **scored}))
    path = folder / "model-7b" / "1_samples_physion_contact.jsonl"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_samples_of_lmms_eval_are_compared(exported: Path, tmp_path: Path) -> None:
    path = _samples(tmp_path, exported, "yes")
    result = physion.compare(path, resamples=20)
    row = result.scores.query("scenario == 'drop' and kind == 'model'").iloc[0]
    assert (row["model"], row["accuracy"], row["stimuli"]) == ("model-7b", 0.5, 4)
    assert not any("count as wrong" in text for text in result.warnings)


def test_missing_answers_count_as_wrong(exported: Path, tmp_path: Path) -> None:
    path = _samples(tmp_path, exported, "yes")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:5], lines[5][:40]]))
    log = read_answers(path)
    rows = log.predictions.set_index("stimulus")["p_contact"]
    assert rows.to_dict() == {"squares_0": 1, "squares_1": 1, "squares_2": 1}, "no answer: wrong"
    assert "1 of 6 answers are missing" in log.warnings[0] and "line is cut" in log.warnings[0]
    result = physion.compare(path, resamples=20)
    assert any("count as wrong (squares_2-contact-2)" in text for text in result.warnings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [*lines, lines[0]], "'squares_0' was answered before"),
        (lambda lines: [lines[0].replace('"version": 1', '"version": 7')], "of version 7"),
        (lambda lines: ['{"doc_id": 3}', lines[0]], "line 1 is not a sample of"),
        (lambda lines: [lines[0][:20], *lines], "line 1 is not JSON"),
        (lambda lines: [lines[0].replace('"order": 0', '"order": "a"')], "order must be"),
        (lambda lines: [lines[0].replace('"contact"', '"view"')], "asks about 'view'"),
    ],
)
def test_bad_samples_are_refused(exported: Path, tmp_path: Path, change: Any, message: str) -> None:
    path = _samples(tmp_path, exported, "A")
    path.write_text("\n".join(change(path.read_text().splitlines())))
    with pytest.raises(BadInputError, match=message):
        read_answers(path)


def test_a_log_of_inspect_says_what_it_needs(tmp_path: Path) -> None:
    if importlib.util.find_spec("inspect_ai") is not None:
        pytest.skip("Inspect is installed here")
    path = tmp_path / "log.eval"
    path.write_bytes(b"PK")
    with pytest.raises(MissingExtraError, match=r"environment of its own: pip install .*inspect"):
        read_answers(path)
    with pytest.raises(MissingExtraError, match=r"physion\.tasks\.inspect needs"):
        importlib.import_module("physion.tasks.inspect")
    table = tmp_path / "predictions.json"
    table.write_text('[{"stimulus": "a", "p_contact": 0.3}]')
    with pytest.raises(BadInputError, match="is not a log of Inspect; save predictions as a CSV"):
        read_answers(table)


def log_of_inspect(
    monkeypatch: pytest.MonkeyPatch, path: Path, answers: list[list[str | None]], status: str
) -> Path:
    """A log of both orders of one stimulus, asked twice; None for an answer that failed."""
    asked = {item_id("a", "contact", order): ("a", "drop", "contact", "yes", order)
             for order in (0, 1)}  # fmt: skip
    samples = [
        SimpleNamespace(id=name, error=None if text else "broken",
                        output=SimpleNamespace(completion=text or ""))
        for name, texts in zip(asked, answers, strict=True)
        for text in texts
    ]  # fmt: skip
    facts = {"physion": 1, "media": "movie", "wording": 1, "asked": asked}
    of_task = SimpleNamespace(
        metadata=facts, model="m", dataset=SimpleNamespace(sample_ids=list(asked)),
        config=SimpleNamespace(epochs=2),
    )  # fmt: skip
    log = SimpleNamespace(eval=of_task, status=status, samples=samples)
    reader = SimpleNamespace(read_eval_log=lambda *_, **__: log)
    monkeypatch.setitem(sys.modules, "inspect_ai", SimpleNamespace(log=reader))
    monkeypatch.setitem(sys.modules, "inspect_ai.log", reader)
    path.write_bytes(b"PK")
    return path


def test_an_answer_that_fails_in_one_epoch_is_wrong(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = log_of_inspect(monkeypatch, tmp_path / "log.eval", [["A", None], ["B", "B"]], "success")
    log = read_answers(path)
    assert log.predictions["p_contact"].tolist() == [3 / 4]
    (warning,) = log.warnings
    assert "1 of 4 answers are missing and count as wrong (a-contact-1)" in warning


def test_a_run_that_did_not_succeed_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = log_of_inspect(monkeypatch, tmp_path / "log.eval", [["A", "A"], ["B", "B"]], "error")
    log = read_answers(path)
    assert log.predictions["p_contact"].tolist() == [1]
    assert log.warnings == (f"{path}: its status is error: inspect eval-retry {path} completes it",)


def test_the_first_option_of_a_control_is_named() -> None:
    assert options_of("left", 1) == ("yellow", "red")
    assert judged("a", "left", "yellow", "red") == JudgedAnswer("a", "yellow", 1, 1, 0)
