"""The check of models: each planted leak is refused by its change; every shipped model passes."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
from PIL import Image

from physion.checking import check
from physion.cli.main import main
from physion.clips.batch import Batch
from physion.core.errors import BadInputError, PhysionError
from physion.models.build import OutOfMemoryError, models
from physion.readout.changes import CHANGES, ChangedTrials, copy_others, take_trials
from physion.readout.check import REFUSED, SHOWN, CheckedModel, _is_of_the_machine
from physion.readout.evaluation import Evaluation, run_evaluations
from physion.readout.settings import choose_models
from physion.readout.tables import read_table
from physion.trials.dataset import Dataset
from physion.trials.index import build_index, write_index
from physion.trials.trial_file import seal
from support import leaking_models as leaks
from support.late_motions import OBSERVED, make_late_motions
from support.moving_dots import make_dots
from support.tiny_models import OPTIONS

TESTED = 8
QUICK = {"blob-trees", "constant-motion", "cswm", "state-trees"}
"""Models of different kinds whose check is quick; the nightly tests check the others."""
HELD = [name for name, change in CHANGES.items() if change.must_hold]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Trials whose files tell the outcome in many ways: the even ones have a contact."""
    folder = tmp_path_factory.mktemp("check") / "trials"
    dataset = make_late_motions(folder, {"readout": 4, "testing": TESTED}, more=1)
    told = {}
    for number, trial in enumerate(dataset.trials("testing")):
        paths, contact = dataset.paths(trial), number % 2 == 0
        told[trial] = float(contact)
        paths.trial_file.with_suffix(".txt").write_text(str(float(contact)))
        picture = np.array(Image.open(paths.map))
        picture[-1, -1] = (255, 0, 0, 255) if contact else (0, 0, 0, 0)
        Image.fromarray(picture).save(paths.map)
        add_title(paths.observed_movie, "contact" if contact else "none")
        add_attribute(paths.trial_file, "note", float(contact))
    table, problems = build_index(folder)
    assert problems == {}
    rng = np.random.default_rng(0)
    for column in ("seed", "engine", "renderer", "package", "scene_digest"):
        table[column] = [f"{n:x}" for n in rng.permutation(len(table))]
    write_index(folder, table)
    (folder / "more/tables").mkdir(parents=True)
    for path in (folder / "labels.json", folder / "more/tables/labels.json"):
        path.write_text(json.dumps(told))
    for number, trial in enumerate(dataset.trials("testing")):
        for path in folder.glob(f"testing/*/{trial}*"):
            os.utime(path, (10**9 + number, 10**9 + number))
    return Dataset(folder)


def add_title(path: Path, title: str) -> None:
    """Write a title into a movie."""
    aside = path.with_suffix(".aside.mp4")
    with av.open(str(path)) as source, av.open(str(aside), "w") as target:
        target.metadata["title"] = title
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    aside.rename(path)


def add_attribute(path: Path, name: str, value: float) -> None:
    """Write an attribute into a trial file, under a seal of its own."""
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
        file["first_frame/ids"][0, 0] = int(value)
    path.write_bytes(seal(path.read_bytes()))


def run(dataset: Dataset, model: Any, folder: Path, *changes: str, **options: Any) -> CheckedModel:
    return check(model, dataset, folder, changes=changes, trials=2 * TESTED, **options)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_model_that_sees_what_was_observed_passes_exactly(made: Dataset, tmp_path: Path) -> None:
    done = run(made, leaks.Honest(), tmp_path, *CHANGES)
    held = done.table[done.table["change"].isin(HELD)]
    assert done.passed and set(held["verdict"]) == {"passed"} and len(held) == len(HELD)
    assert (held["largest"] == 0).all() and (held["moved"] == 0).all()
    assert set(done.table["trials"]) == {TESTED}
    shown = done.table[done.table["verdict"] == SHOWN].set_index("change")
    assert set(shown.index) == set(CHANGES) - set(HELD)
    # The mean over frames is the same in any order, but for the encoder.
    assert shown["largest"]["colours"] > 0.01 > shown["largest"]["reversed"]
    assert not any(tmp_path.iterdir()), "the copies are deleted"
    assert "passed: none of 8 changes" in done.verdict and done.verdict in str(done)


PLANTED: dict[str, tuple[leaks.Tells, str]] = {
    "a number in the name": (leaks.number_in_the_name, "names"),
    "the hash of the name": (leaks.hash_of_the_name, "names"),
    "the name of the scene in the trial file": (leaks.scene_name_in_the_file, "names"),
    "a text file next to the trial": (leaks.file_beside, "names"),
    "a table of labels in the folder": (leaks.table_of_labels, "names"),
    "a table of labels in a folder of the folder": (leaks.table_in_a_folder, "names"),
    "the time of change of a file": (leaks.time_of_the_file, "files"),
    "the size of the observed movie": (leaks.size_of_the_observed_movie, "files"),
    "the title of the observed movie": (leaks.title_of_the_movie, "files"),
    **{
        f"the {column} in the index": (leaks.in_the_index(column), "files")
        for column in ("seed", "engine", "renderer", "package", "scene_digest")
    },
    "an attribute of the HDF5 file": (leaks.attribute_in_the_file, "files"),
    "the id map in the trial file": (leaks.ids_in_the_file, "files"),
    "the map of agent and patient": (leaks.map_of_agent_and_patient, "files"),
    "the size of the movie": (leaks.size_of_the_movie, "future"),
    "the last picture": (leaks.last_picture, "future"),
    "the first picture after the observed part": (leaks.first_picture_after, "future"),
    "the digest of the motion": (leaks.digest_in_the_index, "future"),
    "the motion in the trial file": (leaks.motion_in_the_file, "future"),
    "contacts in the trial file": (leaks.contacts_in_the_file, "future"),
    "the length of the movie": (leaks.length_of_the_movie, "length"),
    "the length in the index": (leaks.length_in_the_index, "length"),
    "the label in the index": (leaks.label_in_the_index, "labels"),
    "the frame of the contact in the index": (leaks.first_frame_in_the_index, "labels"),
    "the label in the trial file": (leaks.label_in_the_file, "labels"),
    "the mean of the labels": (leaks.mean_of_the_labels, "labels"),
    "the row of the index": (leaks.row_of_the_index, "order"),
    "the number in the index": (leaks.number_in_the_index, "order"),
}
"""What a model reads of the evaluated dataset, and the change that must find it."""
FIRST = {change: leak for leak, (_, change) in reversed(PLANTED.items())}
"""The first leak of each change; the nightly tests plant the others."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "leak",
    [
        pytest.param(leak, marks=() if leak in FIRST.values() else pytest.mark.nightly)
        for leak in PLANTED
    ],
)
def test_a_planted_leak_is_refused(leak: str, made: Dataset, tmp_path: Path) -> None:
    tells, change = PLANTED[leak]
    done = run(made, leaks.Cheater(tells), tmp_path, change)
    assert done.refused == [change] and not done.passed
    (row,) = done.table.to_dict("records")
    assert row["verdict"] == REFUSED and row["moved"] > 0 and row["largest"] > 0


MODELS: dict[str, tuple[Callable[[], Any], str]] = {
    "the place in the batch": (leaks.PlaceInBatch, "order"),
    "the other trials of the batch": (leaks.OthersInTheBatch, "order"),
    "the number of calls": (leaks.CallCounter, "again"),
    "a readout fitted on tested trials": (leaks.FitOnTested, "labels"),
    "a memory of answers by name": (leaks.MemoryOfNames, "everything"),
}
"""Models that leak in their own way, and the change that must find it."""


@pytest.mark.parametrize(
    "leak",
    [
        pytest.param(leak, marks=pytest.mark.slow if change in ("labels", "everything") else ())
        for leak, (_, change) in MODELS.items()
    ],
)
def test_a_model_with_a_planted_leak_is_refused(leak: str, made: Dataset, tmp_path: Path) -> None:
    model, change = MODELS[leak]
    assert run(made, model(), tmp_path, change).refused == [change]


@pytest.mark.slow
def test_nothing_after_the_last_frame_of_v1_5_may_be_seen(made: Dataset, tmp_path: Path) -> None:
    """That is frame 15 of Collide, which the observed movie goes beyond."""
    for change in ("future", "length"):
        leaking = leaks.Cheater(leaks.last_observed_picture)
        assert run(made, leaking, tmp_path, change).passed
        assert run(made, leaking, tmp_path, change, benchmark="v1.5").refused == [change]
        (row,) = run(made, leaks.Honest(), tmp_path, change, benchmark="v1.5").table.itertuples()
        assert row.verdict == "passed" and row.moved == 0


def test_answers_in_a_cache_on_disk_are_refused(made: Dataset, tmp_path: Path) -> None:
    answers = {t: 0.9 * (n % 2) for n, t in enumerate(made.trials("testing"))}
    done = run(made, leaks.CacheOnDisk(tmp_path / "cache.json", answers), tmp_path, "names")
    assert done.refused == ["names"]


@pytest.mark.nightly
@pytest.mark.slow
def test_random_numbers_may_follow_the_names(made: Dataset, tmp_path: Path) -> None:
    """But not the outcome: names of the dots are even with a contact."""
    dots = make_dots(tmp_path / "dots", {"readout": 4, "testing": 32}, ("drop",))
    honest: Any = leaks.Imagining()
    done = check(honest, dots, tmp_path, trials=64, changes=["names", "future"])
    rows = done.table.set_index("change")
    assert rows["verdict"].tolist() == ["passed", "passed"]
    assert rows["moved"]["names"] > 0 and "random numbers" in rows["note"]["names"]
    assert rows["moved"]["future"] == 0
    reads: Any = leaks.ImaginesTheName()
    leaking = check(reads, dots, tmp_path, trials=64, changes=["names"])
    assert leaking.refused == ["names"]
    few = run(made, leaks.Imagining(), tmp_path, "names").table
    assert few["verdict"].tolist() == [SHOWN] and "too few trials" in few["note"][0]


@pytest.mark.slow
def test_without_random_numbers_nothing_may_follow_the_names(made: Dataset, tmp_path: Path) -> None:
    (row,) = run(made, leaks.ImaginesTheName(), tmp_path, "names").table.itertuples()
    assert row.verdict == REFUSED and row.note == "another seed moves no prediction"


def test_files_in_folders_are_copied_and_large_ones_named(
    made: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = made.folder / "more/tables"
    (tmp_path / "copy").mkdir()
    assert copy_others(made, tmp_path / "copy") == []
    copied = {path.name for path in (tmp_path / "copy").rglob("*") if path.is_file()}
    beside = {f"{trial}.txt" for trial in made.trials("testing")}
    assert copied == beside | {"labels.json", "index.parquet", "index.parquet.sha256"}
    assert (tmp_path / "copy/more/tables/labels.json").is_file()
    monkeypatch.setattr("physion.readout.changes._LARGEST", (tables / "labels.json").stat().st_size)
    (warning,) = run(made, leaks.Honest(), tmp_path, "again").warnings
    assert "2 files are too large" in warning and "labels.json" in warning


def changed(dataset: Dataset, change: str, folder: Path) -> tuple[ChangedTrials, Dataset]:
    first = folder / "first"
    if not first.is_dir():
        take_trials(dataset, first, 2 * TESTED)
    trials = ChangedTrials(Dataset(first), folder / change, np.random.default_rng(1))
    CHANGES[change].apply(trials)
    return trials, trials.finish()


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        pytest.param(name, marks=() if name == "everything" else pytest.mark.nightly)
        for name in HELD
    ],
)
def test_no_observed_byte_changes_that_must_not(change: str, made: Dataset, tmp_path: Path) -> None:
    """Otherwise an honest model could be refused. The fitting trials are the same files."""
    trials, copy = changed(made, change, tmp_path)
    assert set(trials.names) == set(made.trials("testing"))
    for first, name in trials.names.items():
        assert np.array_equal(made.observed_frames(first), copy.observed_frames(name))
        before, after = made.trial(first).trajectory, copy.trial(name).trajectory
        assert before.positions[:OBSERVED].tobytes() == after.positions[:OBSERVED].tobytes()
        early = [
            motion.contacts.frame[motion.contacts.frame < OBSERVED] for motion in (before, after)
        ]
        assert early[0].tolist() == early[1].tolist() == [10]
    for trial in made.trials("readout"):
        assert made.paths(trial).movie.read_bytes() == copy.paths(trial).movie.read_bytes()
    before_index = Dataset(tmp_path / "first").index
    for column in ("frames", "contact"):
        longest = before_index["frames"].max() == copy.index["frames"].max()
        assert longest, f"{column}: how far models imagine stays"


@pytest.mark.nightly
@pytest.mark.slow
def test_what_is_changed(made: Dataset, tmp_path: Path) -> None:
    """The copies say what they should, by values that are read independently."""
    tested = made.trials("testing")
    _, future = changed(made, "future", tmp_path)
    for trial in tested:
        apart = np.abs(made.frames(trial)[OBSERVED:].astype(int) - future.frames(trial)[OBSERVED:])
        assert apart.mean() > 20
        assert len(made.frames(trial)) == len(future.frames(trial))
    _, length = changed(made, "length", tmp_path)
    counts = {t: (len(made.frames(t)), len(length.frames(t))) for t in tested}
    assert sum(before > after > OBSERVED for before, after in counts.values()) == TESTED - 1
    assert (
        dict(zip(length.index["trial"], length.index["frames"], strict=True)).items()
        >= {trial: after for trial, (_, after) in counts.items()}.items()
    )
    _, labels = changed(made, "labels", tmp_path)
    both = [data.index.set_index("trial").loc[tested]["contact"] for data in (made, labels)]
    assert (both[0] != both[1]).sum() == 0.75 * TESTED
    assert [labels.trial(t).known_labels().contact for t in tested] == both[1].tolist()
    renamed, names = changed(made, "names", tmp_path)
    assert not set(names.trials("testing")) & set(tested)
    assert sorted(renamed.names.values()) == [renamed.names[t] for t in sorted(tested)]
    exchanged, order = changed(made, "order", tmp_path)
    assert order.trials("testing") == tested
    assert all(order.trial(t).metadata.trial == order.trial(t).scene.name == t for t in tested)
    first = made.index.set_index("trial")["digest"]
    last = order.index.set_index("trial")["digest"]
    assert {old: first[old] for old in tested} == {
        old: last[n] for old, n in exchanged.names.items()
    }
    _, files = changed(made, "files", tmp_path)
    sizes = [(d.paths(t).observed_movie.stat().st_size) for d in (made, files) for t in tested]
    assert not set(sizes[:TESTED]) & set(sizes[TESTED:])


@pytest.mark.nightly
@pytest.mark.slow
def test_the_order_of_frames_and_the_colours(made: Dataset, tmp_path: Path) -> None:
    _, backwards = changed(made, "reversed", tmp_path)
    _, shuffled = changed(made, "shuffled", tmp_path)
    _, colours = changed(made, "colours", tmp_path)
    for trial in made.trials("testing"):
        own = made.trial(trial).trajectory
        last = backwards.trial(trial).trajectory
        assert np.array_equal(last.positions[:OBSERVED], own.positions[:OBSERVED][::-1])
        assert np.array_equal(last.velocities[:OBSERVED], -own.velocities[:OBSERVED][::-1])
        assert np.array_equal(last.positions[OBSERVED:], own.positions[OBSERVED:])
        assert last.contacts.frame[0] == OBSERVED - 1 - 10
        seen, turned = made.observed_frames(trial), backwards.observed_frames(trial)
        assert np.abs(seen.astype(int) - turned[::-1]).mean() < 3
        mixed = shuffled.trial(trial).trajectory.positions[:OBSERVED]
        assert not np.array_equal(mixed, own.positions[:OBSERVED])
        assert np.array_equal(np.sort(mixed, axis=0), np.sort(own.positions[:OBSERVED], axis=0))
        # The lower left corner shows the room.
        corner = [d.observed_frames(trial)[0, -4:, :4].mean((0, 1)) for d in (made, colours)]
        assert corner[1] == pytest.approx(0.8 * corner[0][::-1], abs=6)


@pytest.mark.nightly
@pytest.mark.slow
def test_half_of_the_tested_trials_fit_where_there_are_no_others(tmp_path: Path) -> None:
    dots = make_dots(tmp_path / "dots", {"testing": 12}, ("drop", "collide"))
    taken = take_trials(dots, tmp_path / "taken", 16)
    counts = taken.index.groupby(["scenario", "split"])["contact"].agg(["size", "sum"])
    assert counts["size"].tolist() == [4] * 4 and counts["sum"].tolist() == [2] * 4
    assert set(taken.index["trial"]) <= set(dots.index["trial"])
    with pytest.raises(BadInputError, match="no labelled trial in the split 'testing'"):
        take_trials(make_dots(tmp_path / "none", {"readout": 2}, ("drop",)), tmp_path / "x", 8)


def write_models(folder: Path) -> Path:
    """Write a file with a model that leaks and one that does not."""
    file = folder / "own.py"
    file.write_text(
        "from support import leaking_models as leaks\n"
        "class Cheat(leaks.Cheater):\n"
        "    def __init__(self): super().__init__(leaks.number_in_the_name)\n"
        "class Good(leaks.Honest): pass\n"
    )
    return file


@pytest.mark.slow
def test_the_verb(
    made: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    out = tmp_path / "out"
    few = ["--out", str(out), "--trials", "16", "--workers", "1"]
    only = ["--changes", "future,reversed"]
    assert main(["check", "blob-centroids", str(made.folder), *few, *only]) == 0
    text = capsys.readouterr().out
    assert "blob-centroids passed: none of 1 changes moved a prediction" in text
    page = (out / "blob-centroids.html").read_text()
    assert CHANGES["future"].what in page and "must not move a prediction" in page
    file = write_models(tmp_path)
    code = main(["check", f"{file}:Cheat", str(made.folder), *few, "--changes", "names", "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert code == 1 and answer["refused"] == ["names"] and not answer["passed"]
    assert answer["changes"][0]["verdict"] == "refused" and Path(answer["page"]).is_file()
    assert main(["check", "blob-centroids", str(made.folder), "--changes", "futur"]) == 2
    assert "futur" in capsys.readouterr().err


@pytest.mark.nightly
@pytest.mark.slow
def test_a_trial_that_cannot_be_predicted_after_a_change_is_refused(
    made: Dataset, tmp_path: Path
) -> None:
    known = set(made.trials())

    def fails(_: Dataset, trial: str) -> float:
        return dict.fromkeys(known, 0.5)[trial]

    done = run(made, leaks.Cheater(fails), tmp_path, "names")
    assert done.refused == ["names"]
    assert "KeyError" in done.table["note"][0]


@pytest.mark.nightly
@pytest.mark.slow
def test_twins_are_shown(made: Dataset, tmp_path: Path) -> None:
    """The random twin of a model with shipped weights, and blobs, on the same trials."""
    done = check("cswm", made, tmp_path, trials=8, accelerator="cpu")
    rows = done.table.set_index(["change", "readout"])
    assert done.passed, done.table.to_string()
    assert rows["verdict"]["random twin"].tolist() == [SHOWN, SHOWN]
    assert rows["moved"]["random twin"]["observed"] > 0
    assert "fitted on these trials" in rows["note"]["random twin"]["observed"]
    fitted = check("cswm", made, tmp_path, trials=8, accelerator="cpu", readout_from="fit").table
    fitted = fitted.set_index(["change", "readout"])["accuracy"]
    assert rows["accuracy"]["random twin"].tolist() == fitted["random twin"].tolist()
    assert set(rows.loc["blob-centroids"].index) == {"observed"}
    assert set(rows["accuracy_changed"].dropna() * 4 % 1) == {0.0}, "of four tested trials"


class Encoding(leaks.Honest):
    """Model with features, which notes the names of each batch."""

    decision = "logistic"
    answers = ""
    predict: Any = None

    def __init__(self) -> None:
        self.batches: list[tuple[str, ...]] = []

    def encode(self, batch: Batch) -> Any:
        self.batches.append(batch.trials)
        return batch.rgb.astype(np.float32).mean((2, 3))


def test_trials_that_fit_the_readout_are_encoded_once(made: Dataset, tmp_path: Path) -> None:
    """And never in a batch with tested ones, whose sums would be rounded differently then."""
    model: Any = Encoding()
    assert run(made, model, tmp_path, "again", "labels").passed
    fit, tested = set(made.trials("readout")), set(made.trials("testing"))
    seen = [name for batch in model.batches for name in batch]
    assert sorted(name for name in seen if name in fit) == sorted(fit)
    assert sorted(name for name in seen if name in tested) == sorted(3 * list(tested))
    assert all(set(batch) <= fit or set(batch) <= tested for batch in model.batches)


@pytest.mark.slow
def test_evaluate_writes_the_verdict_into_the_table(
    made: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("physion.readout.check.CHANGES", {"names": CHANGES["names"]})
    file = write_models(tmp_path)
    models = f"{file}:Cheat,{file}:Good"
    command = ["evaluate", models, str(made.folder), "--out", str(tmp_path / "out")]
    assert main([*command, "--check", "--workers", "1"]) == 0
    out = capsys.readouterr().out
    tables = [read_table(path) for path in (tmp_path / "out" / "predictions").glob("*.csv")]
    verdicts = {table["model"][0]: set(table["check"]) for table in tables}
    assert verdicts == {"Cheat": {"refused: names"}, "Good": {"passed"}}
    (row,) = (line for line in out.splitlines() if line.startswith("Good"))
    assert "passed" in row
    assert main([*command, "--dry-run"]) == 0, "without the check it is another table"
    assert "2 of 2 evaluations to do" in capsys.readouterr().out


def test_trials_without_a_prediction_are_named(tmp_path: Path) -> None:
    dots = make_dots(tmp_path / "dots", {"readout": 4, "testing": 4}, ("drop",))
    lost = dots.trials("testing")[1]
    dots.paths(lost).observed_movie.write_bytes(b"damaged")
    done = check(leaks.Honest(), dots, tmp_path, trials=8, changes=["again"])
    assert done.table["trials"].tolist() == [3]
    assert (
        f"1 of 4 tested trials have no prediction and are not judged, such as {lost}"
        in (done.warnings[0])
    )


class Failing(leaks.Honest):
    """Model that raises ``error`` after some evaluations, each of which is one call."""

    def __init__(self, error: Exception, after: int = 1) -> None:
        self.error, self.left = error, after

    def predict(self, batch: Batch) -> Any:
        self.left -= 1
        if self.left < 0:
            raise self.error
        return super().predict(batch)


def test_a_path_is_a_model_and_numbers_of_trials_are_positive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "features.npz"
    assert [one.model for one in choose_models(own)] == [str(own)]
    assert [one.model for one in choose_models([own, "gns"])] == [str(own), "gns"]
    with pytest.raises(BadInputError, match=r"features\.npz"):
        check(own, out=tmp_path)
    assert main(["check", "blob-centroids", "--trials", "0", "--out", str(tmp_path / "o")]) == 2
    assert "trials must be at least 1 (--trials), not 0" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_files_are_copied_where_they_cannot_be_linked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any, **__: Any) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    dots = make_dots(tmp_path / "dots", {"testing": 4}, ("drop",))
    take_trials(dots, tmp_path / "first", 4)
    monkeypatch.setattr(os, "link", refused)
    trials = ChangedTrials(Dataset(tmp_path / "first"), tmp_path / "x", np.random.default_rng(1))
    for trial in trials.tested:
        before, after = (
            f / trials.paths(trial).movie.relative_to(tmp_path / "x")
            for f in (tmp_path / "first", tmp_path / "x")
        )
        assert before.read_bytes() == after.read_bytes()
        assert before.stat().st_mtime_ns == after.stat().st_mtime_ns


@pytest.mark.nightly
@pytest.mark.slow
def test_a_failure_that_no_change_made_ends_the_check(made: Dataset, tmp_path: Path) -> None:
    for error, message in (
        (OutOfMemoryError("too few bytes"), "too few bytes"),
        (MemoryError(), "out of memory"),
        (ValueError("broken"), "broken"),  # without any change, too
    ):
        with pytest.raises(PhysionError, match=message):
            run(made, Failing(error), tmp_path, "labels")
    assert _is_of_the_machine(_caused_by(OSError(errno.ENOSPC, "full")))
    assert not _is_of_the_machine(_caused_by(FileNotFoundError(errno.ENOENT, "none")))


def _caused_by(error: OSError) -> BadInputError:
    told = BadInputError("cannot be stored")
    told.__cause__ = error
    return told


@pytest.mark.slow
def test_what_is_only_shown_may_fail(made: Dataset, tmp_path: Path) -> None:
    done = run(made, Failing(ValueError("broken"), 2), tmp_path, "labels", "reversed")
    assert done.passed and set(done.table["change"]) == {"labels"}
    (warning,) = done.warnings
    assert "reversed is not shown" in warning and "broken" in warning


@pytest.mark.nightly
@pytest.mark.slow
def test_others_may_fail_and_a_twin_decides_as_the_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("physion.readout.check.CHANGES", {"labels": CHANGES["labels"]})
    dots = make_dots(tmp_path / "dots", {"readout": 4, "testing": 4}, ("drop",))
    asked: dict[str, str] = {}

    def noted(chosen: Any, *arguments: Any, **options: Any) -> Evaluation:
        init = chosen[0].model.provenance().init
        asked[init] = arguments[2].decision
        if init == "random":
            raise BadInputError("no twin")
        return run_evaluations(chosen, *arguments, **options)

    monkeypatch.setattr("physion.readout.check.run_evaluations", noted)
    done = check("cswm", dots, tmp_path, trials=8, accelerator="cpu", decision="trees")
    assert asked["random"] == "trees"
    assert set(done.table["change"]) == {"labels"} and done.passed
    assert "random twin is not shown: no twin" in done.warnings


def test_changes_of_movies_are_skipped_where_pictures_are_rendered(
    made: Dataset, tmp_path: Path
) -> None:
    done = run(made, leaks.Honest(), tmp_path, "encoded", "colours", rendered=True)
    assert done.table.empty and [w.split()[0] for w in done.warnings] == ["encoded", "colours"]
    assert not done.passed and not done.refused and "not decided: no change" in done.verdict


@pytest.mark.slow
def test_nothing_judged_is_not_passed(
    made: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--out", str(tmp_path), "--trials", "16", "--workers", "1", "--changes", "reversed"]
    assert main(["check", "blob-centroids", str(made.folder), *few]) == 1
    text = capsys.readouterr().out
    assert "blob-centroids not decided: no change was made that must not move" in text
    undecided = run(made, leaks.Imagining(), tmp_path, "names")
    assert not undecided.passed and "not decided: random numbers" in undecided.verdict


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_late_motions(tmp_path_factory.mktemp("few") / "few", {"readout": 4, "testing": 2})


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.nightly)
        for name in sorted(models.names())
    ],
)
def test_every_shipped_model_passes(name: str, few: Dataset, tmp_path: Path) -> None:
    options = OPTIONS.get(name, {})
    kept = ["future", "everything"]
    done = check(
        name, few, tmp_path, options=options, trials=6, changes=kept, accelerator="cpu",
    )  # fmt: skip
    assert done.passed, done.table.to_string()
    exact = done.table[done.table["change"] != "everything"]
    assert (exact["largest"] == 0).all()
