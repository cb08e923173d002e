"""Complete trials: sampled, simulated, labelled, rendered, written, and read back."""

from __future__ import annotations

import dataclasses
import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from physion.compute.local import LocalExecutor, SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.rendering.renderer import Renderer
from physion.scenes.sampling.build import scenarios
from physion.scenes.scene import Ending
from physion.scenes.tdw.read_logs import read_scenes
from physion.trials.dataset import Dataset
from physion.trials.index import index_row
from physion.trials.making.generate import make_trials
from physion.trials.making.make import make_movies, make_trial
from physion.trials.making.plan import GenerateJob, GenerateSettings, TrialTask, plan_dataset
from physion.trials.official import movies as official_movies
from physion.trials.trial_file import Trial
from physion.trials.video import count_frames, open_movie, read_frames
from support.hand_made import make_scene, make_trajectory, tree_digest

PASSES = ("color", "depth", "flow", "ids", "normals")
SMALL = GenerateSettings(width=64, height=64, look="redyellow", passes=PASSES)
TASK = TrialTask("tests", "collide", "testing", 3)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> GenerateJob:
    """A collide trial with all passes, made."""
    job = GenerateJob(TASK, tmp_path_factory.mktemp("made"), SMALL)
    assert make_trial(job) == "collide_testing_0003"
    return job


def test_state_and_labels_match_the_scene(job: GenerateJob) -> None:
    trial = Trial.open(job.paths.trial_file)
    again = simulate(trial.scene)
    assert again.digest() == trial.trajectory.digest() == trial.metadata.digest
    assert label_contact(trial.scene, again) == trial.labels
    assert trial.metadata.seed == f"{TASK.seed().entropy:x}"
    assert trial.metadata.frames == len(again) and trial.metadata.observed_frames == 45
    assert trial.metadata.frame_time == 0.01 and trial.metadata.playback_rate == 30


def test_stored_passes_are_rendered_again_from_the_state(job: GenerateJob) -> None:
    trial = Trial.open(job.paths.trial_file)
    for frame in (0, 44, trial.metadata.frames - 1):
        again, stored = trial.render(frame, PASSES), trial.passes(frame)
        for name in PASSES:
            image = getattr(again, name).astype(stored[name].dtype)
            np.testing.assert_array_equal(stored[name], image, err_msg=name)
    np.testing.assert_array_equal(trial.ids, trial.passes(0)["ids"])


@pytest.mark.parametrize("maker", ["rendered", "imported"])
def test_each_frame_of_both_movies_shows_the_moment_of_its_number(
    maker: str, tmp_path: Path
) -> None:
    """A ball crosses the picture, so that a movie that begins a frame too late shows."""
    scene = make_scene(cloth=False)
    motion = make_trajectory(scene, None)
    positions, rotations = np.zeros_like(motion.positions), np.zeros_like(motion.rotations)
    positions[:, 0, 1], positions[:, :, 2] = np.linspace(-2, 2, len(motion)), (0.6, -5.0)
    rotations[..., 0] = 1.0
    motion = dataclasses.replace(motion, positions=positions, rotations=rotations)
    renderer = Renderer(scene, motion, 96, 96)
    pictures = np.stack([frame.color for frame in renderer.frames()])
    rate = 100 if maker == "rendered" else 30
    if maker == "rendered":
        movies = make_movies(renderer, rate)
    else:
        made = official_movies.make_movies(pictures, len(pictures), rate)
        movies = made.full, made.observed
    for content, count in zip(movies, (len(motion), 45), strict=True):
        (tmp_path / "m.mp4").write_bytes(content)
        with open_movie(tmp_path / "m.mp4") as movie:
            assert movie.properties == (count, 96, 96, rate)
        shown = read_frames(tmp_path / "m.mp4").astype(np.int16)
        away = [np.abs(picture - pictures).mean(axis=(1, 2, 3)) for picture in shown]
        assert np.argmin(away, axis=1).tolist() == list(range(count))
        assert np.min(away) < 3


def test_a_trial_has_the_movies_of_its_state(job: GenerateJob) -> None:
    trial = Trial.open(job.paths.trial_file)
    full, observed = make_movies(trial.renderer(), trial.metadata.playback_rate)
    assert job.paths.movie.read_bytes() == full
    assert job.paths.observed_movie.read_bytes() == observed
    assert count_frames(job.paths.movie) == trial.metadata.frames


def test_map_is_red_on_the_agent_and_yellow_on_the_patient(job: GenerateJob) -> None:
    trial = Trial.open(job.paths.trial_file)
    picture = np.asarray(Image.open(io.BytesIO(job.paths.map.read_bytes())))
    roles, ids = trial.scene.roles, trial.ids
    assert picture.shape == (64, 64, 4)
    for name, color in ((roles.agent, (255, 0, 0, 255)), (roles.patient, (255, 255, 0, 255))):
        thing = trial.scene.index(name)
        shown = (picture == color).all(axis=2)
        np.testing.assert_array_equal(shown, ids == thing + 1)
        assert trial.pixel_fractions[thing] == pytest.approx(shown.mean()) and shown.any()
    others = ~np.isin(ids, [trial.scene.index(n) + 1 for n in (roles.agent, roles.patient)])
    assert not picture[others, 3].any()


def test_looks_change_colours_and_nothing_else(job: GenerateJob, tmp_path: Path) -> None:
    free = GenerateJob(TASK, tmp_path, GenerateSettings(width=64, height=64, look="free"))
    make_trial(free)
    red, other = Trial.open(job.paths.trial_file), Trial.open(free.paths.trial_file)
    assert red.metadata.digest == other.metadata.digest and red.labels == other.labels
    assert job.paths.map.read_bytes() == free.paths.map.read_bytes()
    assert red.scene == other.scene, "stored scenes keep their free colours"
    looks = [{b.name: b.look.color for b in t.shown().bodies} for t in (red, other)]
    assert red.shown("free") == other.shown() and red.shown() == other.shown("redyellow")
    assert looks[0][red.scene.roles.agent] == (1.0, 0.0, 0.0)
    assert looks[0][red.scene.roles.patient] == (1.0, 1.0, 0.0)
    assert looks[1][red.scene.roles.agent] != (1.0, 0.0, 0.0)
    agent = red.ids == red.scene.index(red.scene.roles.agent) + 1
    assert (red.render(0).color[agent] != other.render(0).color[agent]).any()  # type: ignore[index]


def test_only_the_state_is_small_and_passes_are_only_kept_when_asked_for(
    job: GenerateJob, tmp_path: Path
) -> None:
    bare = GenerateJob(TASK, tmp_path, GenerateSettings(width=64, height=64, look="redyellow"))
    make_trial(bare)
    assert Trial.open(bare.paths.trial_file).pass_names == ()
    assert bare.paths.movie.read_bytes() == job.paths.movie.read_bytes()
    frames = index_row(bare.paths)["frames"]
    assert bare.paths.trial_file.stat().st_size < 20_000 + 1000 * frames


def test_short_trials_and_unknown_presets_are_refused(tmp_path: Path) -> None:
    scene = dataclasses.replace(
        make_scene("short", cloth=False), ending=Ending(min_frames=20, max_frames=30)
    )
    with pytest.raises(BadInputError, match=r"'short' has .* frames; nothing is left to predict"):
        make_trial(GenerateJob(TrialTask("d", "drop", "testing", 0, scene=scene), tmp_path, SMALL))
    with pytest.raises(UnknownNameError, match="preset of drop 'hard'"):
        make_trial(GenerateJob(TrialTask("d", "drop", "testing", 0, "hard"), tmp_path, SMALL))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_fresh_processes_make_the_same_bytes_whatever_their_environment(
    job: GenerateJob, tmp_path: Path
) -> None:
    script = (
        "import sys; from pathlib import Path\n"
        "from physion.trials.making.make import make_trial\n"
        "from physion.trials.making.plan import *\n"
        f"make_trial(GenerateJob({TASK!r}, Path(sys.argv[1]), {SMALL!r}))\n"
    )
    strange = {
        "PYTHONHASHSEED": "7",
        "OMP_NUM_THREADS": "2",
        "TZ": "Asia/Tokyo",
        "LANG": "tr_TR.UTF-8",
    }
    subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "made")],
        env={**os.environ, **strange},
        cwd=tmp_path,
        check=True,
    )
    assert tree_digest(tmp_path / "made") == tree_digest(job.folder)


@pytest.mark.nightly
@pytest.mark.slow
def test_dataset_of_every_scenario_with_real_workers(tmp_path: Path) -> None:
    tasks = plan_dataset("tests", scenarios.names(), {"testing": 1})
    report = make_trials(
        tmp_path / "two",
        tasks,
        GenerateSettings(width=64, height=64, look="redyellow"),
        executor=LocalExecutor(2),
    )
    assert report.exit_code == 0 and len(report.made) == len(tasks)
    dataset = Dataset(tmp_path / "two")
    assert sorted(dataset.trials()) == sorted(task.trial for task in tasks)
    assert (dataset.index[["agent_fraction", "patient_fraction"]] > 0).to_numpy().all()
    serial = make_trials(
        tmp_path / "one",
        tasks[::-1],
        GenerateSettings(width=64, height=64, look="redyellow"),
        executor=SerialExecutor(),
    )
    assert serial.exit_code == 0
    assert tree_digest(tmp_path / "one") == tree_digest(tmp_path / "two")


@pytest.mark.slow
def test_official_scenes_become_trials(official: Path, tmp_path: Path) -> None:
    found = read_scenes(official / "scenes", scenario="dominoes", limit=2)
    tasks = [
        TrialTask("official", "dominoes", "testing", i, None, trial.scene, trial.outcome.contact)
        for i, trial in enumerate(found.trials)
    ]
    report = make_trials(
        tmp_path / "s",
        tasks,
        GenerateSettings(width=64, height=64, look="redyellow"),
        executor=SerialExecutor(),
    )
    assert report.exit_code == 0
    dataset = Dataset(tmp_path / "s")
    table = dataset.index.set_index("trial")
    for trial in found.trials:
        assert table.loc[trial.scene.name, "recorded_contact"] == trial.outcome.contact
        assert dataset.trial(trial.scene.name).scene.bodies[0].name == trial.scene.bodies[0].name
