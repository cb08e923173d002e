"""Generation of datasets: plans, choices of scenes, kills, failures, other engines."""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import physion
from physion.clips.clips import clips
from physion.compute.local import LocalExecutor, SerialExecutor
from physion.compute.run_tasks import RunReport
from physion.core.errors import BadInputError, PhysionError, UnknownNameError
from physion.core.files import folder_lock, write_atomic
from physion.physics.engine import make_engine
from physion.readout.evaluate import evaluate
from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths, find_trials
from physion.trials.index import build_index, index_row, read_index
from physion.trials.making import generate as module
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import (
    GenerateJob,
    GenerateSettings,
    TrialTask,
    plan_dataset,
    plan_scenes,
)
from physion.trials.making.verify import verify_dataset
from physion.trials.trial_file import Trial
from physion.trials.video import read_frames
from support.hand_made import make_by_hand, make_scene, tree_digest
from support.paths import TESTS

FILES = {"h5", "_img.mp4", "_observed.mp4", "_map.png"}


def scenes_named(*names: str) -> list[TrialTask]:
    return plan_scenes("tests", [make_scene(name) for name in names])


def run(folder: Path, tasks: list[TrialTask], **options: Any) -> RunReport:
    options.setdefault("executor", SerialExecutor())
    return make_trials(folder, tasks, make=make_by_hand, **options)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four trials, made without interruption."""
    folder = tmp_path_factory.mktemp("finished") / "set"
    run(folder, scenes_named("a", "b", "c", "d"))
    return folder


@pytest.mark.slow
def test_new_rows_of_the_index_equal_their_files(
    finished: Path,
) -> None:
    pd.testing.assert_frame_equal(Dataset(finished).index, build_index(finished)[0])


def test_index_equals_the_files(finished: Path) -> None:
    dataset = Dataset(finished)
    assert dataset.trials() == ["a", "b", "c", "d"]
    assert [dataset[row].metadata.trial for row in range(4)] == dataset.trials()
    for paths in find_trials(finished):
        row = index_row(paths)
        stored = dataset.index[dataset.index["trial"] == paths.trial].iloc[0]
        for name, value in row.items():
            assert (value is None and stored[name] is not True) or stored[name] == value, name
        trial = dataset.trial(paths.trial)
        assert stored["contact"] == trial.labels.contact == (paths.trial in "bd")
        assert stored["digest"] == trial.trajectory.digest()
        assert stored["agent_fraction"] == 64 / 1024 and stored["patient_fraction"] == 512 / 1024
    assert dataset.index["first_frame"].isna().tolist() == [True, False, True, False]


@pytest.mark.nightly
@pytest.mark.slow
def test_without_labels_training_trials_hold_no_outcome_and_no_roles(tmp_path: Path) -> None:
    tasks = plan_dataset("plain", ("collide",), {"training": 1, "readout": 2, "testing": 2})
    made = {}
    for labels in (True, False):
        settings = GenerateSettings(width=64, height=64, jitters=0, labels=labels)
        folder = tmp_path / str(labels)
        assert not make_trials(folder, tasks, settings, executor=SerialExecutor()).failed
        assert not verify_dataset(folder, again=5).faults
        again = make_trials(folder, tasks, settings, executor=SerialExecutor())
        assert not again.made, "nothing is missing"
        made[labels] = Dataset(folder)
    full, plain = made[True], made[False]
    (training,) = plain.trials("training")
    rows = plain.index.set_index("trial")
    hidden = [
        "contact", "first_frame", "observed_contact", "min_distance", "robust", "agent_fraction",
        "patient_fraction", "map", "map_sha256", "recorded_contact",
    ]  # fmt: skip
    assert rows.loc[training, hidden].isna().all()
    assert rows.drop(index=training)["contact"].tolist() == (
        full.index.set_index("trial").drop(index=training)["contact"].tolist()
    )
    assert plain.trial(training).labels is None
    assert not list((plain.folder / "training").rglob("*_map.png"))
    assert len(list(plain.folder.rglob("*_map.png"))) == 4
    known, kept = full.index.set_index("trial"), ["digest", "movie_sha256", "observed_movie_sha256"]
    assert known[kept].equals(rows[kept]), "else they are the same trials"
    assert known["contact"].dtype == bool and rows["contact"].dtype == "boolean"
    with pytest.raises(BadInputError, match="stored without labels"):
        clips(plain, size=16)
    assert len(clips(plain, size=16, labels=False)) == 5
    assert len(clips(plain, size=16, split="readout")) == 2
    found = evaluate("blob-centroids", plain, tmp_path / "out").predictions
    expected = evaluate("blob-centroids", full, tmp_path / "out").predictions
    pd.testing.assert_frame_equal(found, expected)


def test_observed_frames_need_no_file_with_the_future(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "set")
    dataset = Dataset(tmp_path / "set")
    for paths in find_trials(tmp_path / "set"):
        if paths.trial == "d":
            shutil.copy(paths.movie, paths.observed_movie)
        paths.movie.unlink()
        paths.trial_file.unlink()
    assert [len(dataset.observed_frames(name)) for name in "abc"] == [45] * 3
    with pytest.raises(BadInputError, match="46 frames"):
        dataset.observed_frames("a", count=46)
    with pytest.raises(UnknownNameError, match="closest"):
        dataset.observed_frames("aa")
    # A movie that shows more is refused.
    with pytest.raises(BadInputError, match="was changed since it was made"):
        dataset.observed_frames("d")
    with pytest.raises(BadInputError, match="more than the 45 observed"):
        Dataset(tmp_path / "set", verify=False).observed_frames("d")


def test_second_run_does_nothing(finished: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    report = run(finished, scenes_named("a", "b", "c", "d"))
    assert (report.made, report.kept, report.exit_code) == ([], ["a", "b", "c", "d"], 0)
    after = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    # The folder itself changes, since the lock comes and goes.
    assert {p: t for p, t in after.items() if p != finished} == before


@pytest.mark.slow
def test_any_missing_file_is_made_again(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "set")
    for index, path in enumerate(Dataset(tmp_path / "set").paths("b").all().values()):
        path.unlink()
        report = run(tmp_path / "set", scenes_named("a", "b", "c", "d"))
        assert report.made == ["b"] and index < 4
    assert tree_digest(tmp_path / "set") == tree_digest(finished)


def test_more_trials_later_change_none_of_the_first(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "s"
    assert run(folder, scenes_named("a", "b")).made == ["a", "b"]
    (folder / "testing" / "drop" / ".1234-abcd.part").write_bytes(b"half")  # of a killed writer
    assert run(folder, scenes_named("a", "b", "c", "d")).made == ["c", "d"]
    assert tree_digest(folder) == tree_digest(finished)


@pytest.mark.slow
def test_workers_and_order_do_not_matter(finished: Path, tmp_path: Path) -> None:
    # Scenes keep the index that they have in their set, whatever the order of work.
    tasks = scenes_named("a", "b", "c", "d")
    report = run(tmp_path / "s", [tasks[i] for i in (2, 0, 3, 1)], executor=LocalExecutor(3))
    assert report.exit_code == 0
    assert tree_digest(tmp_path / "s") == tree_digest(finished)


def test_a_failing_trial_is_reported_and_the_others_continue(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    run(folder, scenes_named("c"))
    (folder / "failures").mkdir()
    (folder / "failures" / "a.txt").write_text("old")
    report = run(folder, scenes_named("a", "bad", "c"))
    assert (report.exit_code, report.made, report.kept) == (1, ["a"], ["c"])
    assert report.failed == {"bad": "bad cannot be made"}
    # The note of a failure goes when its trial is made.
    (path,) = (folder / "failures").iterdir()
    note = path.read_text()
    assert "Traceback" in note and "make_by_hand" in note and '"name":"bad"' in note
    assert Dataset(folder).trials() == ["a", "c"]


@pytest.mark.nightly
@pytest.mark.slow
def test_a_poison_trial_is_put_aside(tmp_path: Path) -> None:
    report = run(tmp_path / "s", scenes_named("a", "die", "c"), executor=LocalExecutor(1))
    assert report.made == ["a", "c"] and "SIGKILL" in report.failed["die"]
    assert "tries: 3" in (tmp_path / "s" / "failures" / "die.txt").read_text()


class Fault:
    """Makes the k-th call of a system function fail."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, name: str, number: int, code: int) -> None:
        self.calls, self._number, self._code = 0, number, code
        self._real: Callable[..., Any] = getattr(os, name)
        monkeypatch.setattr(os, name, self)

    def __call__(self, *arguments: Any) -> Any:
        self.calls += 1
        if self.calls == self._number:
            if self._real is os_write:
                self._real(arguments[0], bytes(arguments[1][: len(arguments[1]) // 2]))
            raise OSError(self._code, os.strerror(self._code))
        return self._real(*arguments)


os_write = os.write


def check_only_whole_files(folder: Path) -> None:
    """Every file under its own name can be read to its end."""
    for path in folder.rglob("*"):
        if path.is_file():
            assert not path.name.endswith(".part"), path
    for paths in find_trials(folder):
        assert paths.complete()
        assert len(Trial.open(paths.trial_file).trajectory) == 60
        assert len(read_frames(paths.movie)) == 60


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("write", errno.ENOSPC),
        pytest.param("replace", errno.EIO, marks=pytest.mark.slow),
        pytest.param("fsync", errno.EIO, marks=[pytest.mark.slow, pytest.mark.nightly]),
    ],
)
def test_a_fault_at_every_step_leaves_only_whole_files(
    name: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clean = tmp_path / "clean"
    with monkeypatch.context() as patch:
        counter = Fault(patch, name, 0, code)
        run(clean, scenes_named("a"))
    # Settings, six files of the trial, index and its SHA-256; fsync also for each folder.
    assert counter.calls == {"write": 9, "replace": 9, "fsync": 18}[name]
    for number in range(1, counter.calls + 1):
        folder = tmp_path / f"{number}"
        with monkeypatch.context() as patch:
            Fault(patch, name, number, code)
            with pytest.raises(PhysionError, match=f"cannot write into {folder}: "):
                run(folder, scenes_named("a"))
        check_only_whole_files(folder)
        run(folder, scenes_named("a"))
        assert tree_digest(folder) == tree_digest(clean)


def test_a_full_disk_stops_the_run_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counter = Fault(monkeypatch, "write", 10, errno.ENOSPC)
    with pytest.raises(PhysionError, match=r"No space left.*1 of . are complete"):
        run(tmp_path / "s", scenes_named("a", "b", "c"))
    assert counter.calls == 10, "no later trial is tried"


def test_a_stopped_run_leaves_an_index_and_reads_no_listed_trial_again(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "s"
    monkeypatch.setattr(module, "INDEX_EVERY", 2)

    def stop_at_last(job: GenerateJob) -> str:
        if job.task.trial == "d":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return make_by_hand(job)

    tasks = scenes_named("a", "b", "c", "d")
    with pytest.raises(PhysionError, match="3 of 4 are complete"):
        make_trials(folder, tasks, make=stop_at_last, executor=SerialExecutor())
    listed = list(read_index(folder)["trial"])
    assert len(listed) == 2
    read: list[str] = []
    real = Trial.open
    monkeypatch.setattr(Trial, "open", lambda path: read.append(Path(path).stem) or real(path))
    run(folder, tasks)
    assert sorted(set(read)) == sorted({"a", "b", "c", "d"} - set(listed))
    assert tree_digest(folder) == tree_digest(finished)


LIMITED = """
import resource, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from support.paths import TESTS
from support.hand_made import make_by_hand, make_scene
from physion.compute.local import SerialExecutor
from physion.core.errors import PhysionError
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import plan_scenes
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
tasks = plan_scenes("tests", [make_scene("a")])
try:
    make_trials(Path(sys.argv[1]), tasks, make=make_by_hand, executor=SerialExecutor())
except PhysionError as error:
    print(error)
    sys.exit(error.exit_code)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs resource limits")
def test_the_system_refusing_to_write_more_is_an_error_and_not_a_crash(
    finished: Path, tmp_path: Path
) -> None:
    """A real refusal in the middle of a file: libraries that write by themselves crash here."""
    arguments = [str(tmp_path / "s"), str(TESTS)]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *arguments], capture_output=True, text=True
    )
    assert done.returncode == 2 and "File too large" in done.stdout, done.stderr
    check_only_whole_files(tmp_path / "s")
    run(tmp_path / "s", scenes_named("a", "b", "c", "d"))
    assert tree_digest(tmp_path / "s") == tree_digest(finished)


KILLED = """
import sys
import time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from support.paths import TESTS
from support.hand_made import make_by_hand, make_scene
from physion.compute.local import LocalExecutor
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import plan_scenes
told = []
def progress(what, done, total):
    if done:
        print(done, flush=True)
        told.append(done)
    if len(told) == int(sys.argv[4]):
        time.sleep(600)  # until the kill, however late it is; the worker goes on with one trial
if __name__ == "__main__":
    names = [f"t{n:02d}" for n in range(int(sys.argv[3]))]
    tasks = plan_scenes("tests", [make_scene(name) for name in names])
    executor = LocalExecutor(1)
    make_trials(Path(sys.argv[1]), tasks, make=make_by_hand, executor=executor, progress=progress)
"""


def run_and_kill(folder: Path, trials: int, after: int, delay: float) -> int:
    """Make trials in processes of their own; kill all of them ``delay`` s after so many trials."""
    script = folder.with_suffix(".py")
    script.write_text(KILLED)
    command = [
        sys.executable,
        str(script),
        str(folder),
        str(TESTS),
        str(trials),
        str(after),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    for _ in range(after):
        process.stdout.readline()
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGKILL)
    code = process.wait()
    process.stdout.close()
    for paths in find_trials(folder):
        assert paths.complete()
        Trial.open(paths.trial_file)
    return code


@pytest.mark.parametrize(
    ("kills", "trials"),
    [(1, 8), pytest.param(5, 16, marks=[pytest.mark.slow, pytest.mark.nightly])],
)
def test_killed_runs_resume_to_the_same_tree(kills: int, trials: int, tmp_path: Path) -> None:
    chance = random.Random(kills)
    killed = [
        run_and_kill(tmp_path / "killed", trials, after=2, delay=chance.uniform(0, 0.05))
        for _ in range(kills)
    ]
    assert killed == [-signal.SIGKILL] * kills
    assert 0 < len(find_trials(tmp_path / "killed")) < trials
    tasks = scenes_named(*(f"t{number:02d}" for number in range(trials)))
    report = run(tmp_path / "killed", tasks)
    assert len(report.kept) >= 2 * kills and len(report.made) + len(report.kept) == trials
    run(tmp_path / "whole", tasks)
    assert tree_digest(tmp_path / "killed") == tree_digest(tmp_path / "whole")


def test_folders_of_others_are_refused(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadInputError, match=r"settings\.width 256, now 64"):
        run(finished, scenes_named("a"), settings=GenerateSettings(width=64))
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(BadInputError, match=r"contains 'thesis\.tex'"):
        run(tmp_path, scenes_named("a"))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    folder = tmp_path / "s"
    folder.mkdir()
    with folder_lock(folder), pytest.raises(PhysionError, match="another process is writing"):
        run(folder, scenes_named("a"))
    assert run(folder, scenes_named("a")).made == ["a"]
    monkeypatch.setattr("physion.trials.making.make.RENDERER", "physion-99")
    with pytest.raises(BadInputError, match=r"made_by"):
        run(folder, scenes_named("a", "b"))


def test_folder_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(BadInputError, match="is a file; give a folder to write into"):
        run(tmp_path / "file", scenes_named("a"))
    for folder in (tmp_path / "file" / "below", Path("/proc/physion")):
        with pytest.raises(BadInputError, match="cannot write into"):
            run(folder, scenes_named("a"))


def test_broken_and_renamed_trials_are_found_when_the_index_is_made(
    finished: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "s"
    shutil.copytree(finished, folder)
    paths = Dataset(folder).paths("b")
    paths.trial_file.write_bytes(paths.trial_file.read_bytes()[:-7])
    (folder / "index.parquet").unlink()
    report = run(folder, scenes_named("a"))
    assert list(report.failed) == ["b"] and "cut short" in report.failed["b"]
    assert report.exit_code == 1 and Dataset(folder).trials() == ["a", "c", "d"]
    assert report.kept == ["a"]
    old, new = Dataset(folder).paths("c"), TrialPaths(folder, "testing", "drop", "other")
    for name, path in old.all().items():
        path.rename(new.all()[name])
    table, problems = build_index(folder)
    assert table["trial"].tolist() == ["a", "d"]
    assert "is trial 'c' of testing/drop: it was moved or renamed" in problems["other"]


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("column", ["trial_file", "movie"])
def test_a_file_of_another_size_is_made_again(
    finished: Path, tmp_path: Path, indexed: bool, column: str
) -> None:
    folder = tmp_path / "s"
    shutil.copytree(finished, folder)
    path = Dataset(folder).paths("b").all()[column]
    path.write_bytes(b"" if column == "trial_file" else path.read_bytes()[:-3])
    if not indexed:
        (folder / "index.parquet").unlink()
    report = run(folder, scenes_named("a", "b", "c", "d"))
    if column == "movie" and not indexed:
        # Nothing tells its size; it is found by `verify`, which compares it with the motion.
        assert report.made == []
        return
    assert report.made == ["b"] and report.kept == ["a", "c", "d"] and not report.failed
    assert tree_digest(folder) == tree_digest(finished)


def test_missing_and_broken_indexes_are_refused(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="does not exist"):
        Dataset(tmp_path / "none")
    with pytest.raises(BadInputError, match=r"has no index\.parquet"):
        Dataset(tmp_path)
    for content in (b"", b"PAR1 no", (finished / "index.parquet").read_bytes()[:-100]):
        (tmp_path / "index.parquet").write_bytes(content)
        with pytest.raises(BadInputError, match=r"index\.parquet cannot be read"):
            Dataset(tmp_path)
    table = Dataset(finished).index
    for message, wrong in (
        ("lacks the columns", table.drop(columns="digest")),
        ("column 'trial' has", table.assign(trial="../../etc/passwd")),
        ("duplicate names", table.assign(trial="a")),
    ):
        wrong.to_parquet(tmp_path / "index.parquet")
        with pytest.raises(BadInputError, match=message):
            Dataset(tmp_path)


def test_plan_gives_every_trial_its_own_seed_and_name() -> None:
    counts = {"training": 5, "readout": 4, "testing": 3, "familiarization": 1}
    presets = {"drop": ["default", "debug"]}
    tasks = plan_dataset("d", ["drop", "collide"], counts, presets)
    assert len({task.trial for task in tasks}) == len(tasks) == 26
    seeds = {replace(task, attempt=attempt).seed().entropy for task in tasks for attempt in (0, 1)}
    assert len(seeds) == 2 * 26
    assert {t.presets for t in tasks if t.scenario == "drop"} == {("default", "debug")}
    practice = next(t for t in tasks if (t.scenario, t.split) == ("collide", "familiarization"))
    assert practice.presets == ("familiarization",)
    longer = plan_dataset("d", ["drop"], {"training": 9}, presets)
    assert longer[:5] == [t for t in tasks if (t.scenario, t.split) == ("drop", "training")]


@pytest.mark.parametrize("name", ["../up", "a/b", "", ".hidden", "a b", "x" * 201, "nul\0"])
def test_names_that_are_no_file_names_are_refused(name: str) -> None:
    with pytest.raises(BadInputError, match="file name"):
        scenes_named(name)


def test_bad_plans_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="closest: testing"):
        TrialTask("d", "drop", "test", 0)
    with pytest.raises(UnknownNameError, match="unknown scenario 'dropp'; closest: drop"):
        plan_dataset("d", ["dropp"], {"testing": 1})
    with pytest.raises(UnknownNameError, match="preset of drop 'defaultt'; closest: default"):
        plan_dataset("d", ["drop"], {"testing": 1}, {"drop": ["defaultt"]})
    with pytest.raises(BadInputError, match="two trials are called 'A'"):
        scenes_named("a", "A")
    with pytest.raises(BadInputError, match="one dataset"):
        run(
            tmp_path / "s",
            [TrialTask("d", "drop", "testing", 0), TrialTask("e", "drop", "testing", 1)],
        )
    for wrong in ({"width": 33}, {"passes": ("colour",)}, {"look": "blue"}, {"engine": "mujocco"}):
        with pytest.raises((BadInputError, UnknownNameError), match=str(*wrong)):
            GenerateSettings(**wrong)  # type: ignore[arg-type]


def test_writers_of_one_path_do_not_meet(tmp_path: Path) -> None:
    """Two processes that write the same path at once: one of the two contents, never a mixture."""
    path = tmp_path / "f"
    script = (
        "import sys; from pathlib import Path; from physion.core.files import write_atomic\n"
        "for _ in range(200): write_atomic(Path(sys.argv[1]), sys.argv[2].encode() * 20000)\n"
    )
    writers = [
        subprocess.Popen([sys.executable, "-c", script, str(path), letter]) for letter in "xy"
    ]
    while any(writer.poll() is None for writer in writers):
        content = path.read_bytes() if path.exists() else b"x" * 20000
        assert content in (b"x" * 20000, b"y" * 20000)
        time.sleep(0.002)
    assert [writer.returncode for writer in writers] == [0, 0]
    assert [item.name for item in tmp_path.iterdir()] == ["f"]
    with pytest.raises(FileNotFoundError):
        write_atomic(tmp_path / "no" / "f", b"")


# `physion.generate`: plans, makes and opens a dataset, and says when trials are missing.


def plan_of(monkeypatch: pytest.MonkeyPatch, folder: Path, *arguments: Any, **more: Any) -> Any:
    """Return the tasks that a call would make, without making them."""
    seen: list[Any] = []

    def note(folder: Path, tasks: Any, settings: Any, **rest: Any) -> RunReport:
        seen.append(tasks)
        return RunReport([], [], {}, folder / "index")

    monkeypatch.setattr(module, "make_trials", note)
    monkeypatch.setattr(module, "GeneratedDataset", lambda folder, report: folder)
    assert physion.generate(folder, *arguments, **more) == folder
    return seen[0]


def test_the_plan_matches_the_command_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert plan_of(monkeypatch, tmp_path, "drop", 3) == plan_dataset(
        "physion", ["drop"], {"testing": 3}
    )
    assert len(plan_of(monkeypatch, tmp_path, counts=2)) == 2 * 8, "all scenarios"
    counts = {"training": 2, "readout": 1}
    tasks = plan_of(monkeypatch, tmp_path, ("drop", "roll"), counts, name="mine")
    assert tasks == plan_dataset("mine", ["drop", "roll"], counts)
    assert plan_of(monkeypatch, tmp_path, "drop,roll", counts, name="mine") == tasks
    tasks = plan_of(monkeypatch, tmp_path, "collide", 2, presets=["debug"])
    assert {task.presets for task in tasks} == {("debug",)}


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("dominos", 1), {}, "unknown scenario 'dominos'; closest: dominoes"),
        (("drop", {"tests": 1}), {}, "unknown split 'tests'"),
        (("drop", 0), {}, "1 or more"),
        (("drop", {}), {}, "1 or more"),
        (("all", 1), {"presets": ["debug"]}, "presets need one scenario"),
        (("drop", 1), {"presets": ["no such"]}, "unknown preset of drop"),
    ],
)
def test_wrong_arguments_are_refused_before_a_folder_is_made(
    arguments: tuple[Any, ...], options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises((BadInputError, UnknownNameError), match=message):
        physion.generate(tmp_path / "new", *arguments, **options)
    assert not (tmp_path / "new").exists()


def test_trials_that_fail_are_an_error_that_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(folder: Path, tasks: Any, settings: GenerateSettings, **rest: Any) -> RunReport:
        return RunReport(["a"], [], {"drop_testing_0001": "no scene fits"}, folder / "index")

    monkeypatch.setattr(module, "make_trials", fail)
    with pytest.raises(PhysionError, match=r"1 of 2 trials .*'drop_testing_0001': no scene fits"):
        physion.generate(tmp_path, "drop", 2)


# Trials made with an engine that is not the default one.


MUJOCO = GenerateSettings(
    width=32, height=32, jitters=1, min_visible=0.0, movies=False, engine="mujoco"
)


@pytest.mark.nightly
@pytest.mark.slow
def test_trials_of_another_engine_are_verified_with_it(tmp_path: Path) -> None:
    tasks = plan_dataset("tests", ["collide"], {"testing": 1})
    report = make_trials(tmp_path, tasks, MUJOCO, executor=SerialExecutor())
    assert not report.failed
    (name,) = Dataset(tmp_path).index["engine"]
    assert name == make_engine("mujoco").name
    result = verify_dataset(tmp_path, again=-1)
    assert result.faults == [] and result.other_versions == []
