"""Nothing of an observed source leads to what happens after the observed part."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.clips.batch import Batch, Motion, Spec, cut_to_observed
from physion.clips.clips import observed_source, whole_source
from physion.clips.source import FutureFrameError, ObservedSource, WholeSource
from physion.clips.states import TrialMotions, cut_motion, digest_in, motion_digest
from physion.core.errors import BadInputError
from physion.physics.trajectory import Contacts, Trajectory
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.dataset import Dataset
from physion.trials.trial_file import Trial
from physion.trials.video import encode_movie
from support.hand_made import write_trial
from support.official_hand_made import CLOTH, FRAMES, RIGID, SIZE, make_scene, make_trajectory

EVERYTHING = ("rgb", "ids", "depth", "boxes", "camera", "state")
SPEC = Spec(inputs=EVERYTHING, image_size=16, stride=4, context=12, future=1, context_at="start")
SPECS = {
    "rgb": dataclasses.replace(SPEC, inputs=("rgb",)),
    "state": dataclasses.replace(SPEC, inputs=("state",)),
    "all": SPEC,
    "end": dataclasses.replace(SPEC, context=11, context_at="end"),
    "default": Spec(inputs=EVERYTHING, image_size=16),
    "every frame": dataclasses.replace(SPEC, stride=1, context=45),
}


def noise_after_the_observed_part(trajectory: Trajectory) -> Trajectory:
    """The trajectory with noise in everything after frame 44, and other contacts there."""
    rng = np.random.default_rng(11)
    noisy: dict[str, Any] = {}
    for name in (
        *("positions", "rotations", "velocities", "angular_velocities"),
        *("cloth_vertices", "cloth_distance"),
    ):
        values = getattr(trajectory, name).copy()
        later = values[OBSERVED_FRAMES:]
        later[...] = rng.normal(size=later.shape)
        noisy[name] = values
    contacts = trajectory.contacts
    kept = contacts.frame < OBSERVED_FRAMES
    added = Contacts(
        *(np.concatenate([getattr(contacts, f.name)[kept], new]) for f, new in zip(
            dataclasses.fields(Contacts),
            (
                np.arange(OBSERVED_FRAMES, FRAMES, dtype=np.int32),
                np.tile(np.array([[0, 2]], np.int32), (FRAMES - OBSERVED_FRAMES, 1)),
                rng.normal(size=(FRAMES - OBSERVED_FRAMES, 3)).astype(np.float32),
                rng.normal(size=(FRAMES - OBSERVED_FRAMES, 3)).astype(np.float32),
                rng.uniform(size=FRAMES - OBSERVED_FRAMES).astype(np.float32),
            ),
            strict=True,
        ))
    )  # fmt: skip
    return dataclasses.replace(trajectory, contacts=added, **noisy)


@pytest.fixture(scope="module")
def noisy(made: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The dataset with noise in every file after frame 44."""
    folder = tmp_path_factory.mktemp("noisy") / "noisy"
    shutil.copytree(made.folder, folder)
    rng = np.random.default_rng(7)
    for name in made.trials():
        paths = Dataset(folder).paths(name)
        trial = Trial.open(paths.trial_file)
        motion = noise_after_the_observed_part(trial.trajectory)
        labels = dataclasses.replace(trial.labels, contact=not trial.labels.contact)
        write_trial(paths.trial_file, trial.metadata, trial.scene, motion, labels, trial.ids)
        noise = rng.integers(0, 256, (FRAMES, SIZE, SIZE, 3), np.uint8)
        for movie in (paths.movie, paths.free_movie):
            movie.write_bytes(encode_movie(noise))
    return Dataset(folder, verify=False)  # the index has the SHA-256 of the files without noise


def as_bytes(batch: Batch) -> list[Any]:
    """All that a batch holds, as bytes and text."""
    parts: list[Any] = [(name, a.tobytes()) for name, a in sorted(batch.arrays().items())]
    for motion in batch.state or ():
        trajectory = motion.trajectory
        parts += [motion.scene.to_json(), trajectory.digest(), trajectory.engine]
        parts += [trajectory.completed]
    return parts


@pytest.mark.parametrize("name", sorted(SPECS))
@pytest.mark.parametrize("rendered", [False, True])
def test_noise_after_the_observed_part_changes_no_byte_of_the_context(
    made: Dataset, noisy: Dataset, name: str, rendered: bool
) -> None:
    sources = [observed_source(data, SPECS[name], rendered=rendered) for data in (made, noisy)]
    trials = [RIGID, CLOTH]
    clean, changed = (as_bytes(source.context(trials)) for source in sources)
    assert clean == changed
    for trial in trials:
        assert len({source.key(trial, "context") for source in sources}) == 1


def test_the_noise_shows_in_whole_trials(made: Dataset, noisy: Dataset) -> None:
    """Else the test above would prove nothing. Frame 48 is the only one after frame 44."""
    for inputs in (("rgb",), ("ids",), ("depth",), ("state",)):
        spec = dataclasses.replace(SPEC, inputs=inputs)
        sources = [whole_source(data, spec) for data in (made, noisy)]
        clean, changed = (as_bytes(source.whole([RIGID])) for source in sources)
        assert clean != changed, inputs
        if inputs != ("rgb",):  # the index still has the SHA-256 of the movie
            assert sources[0].key(RIGID, "whole") != sources[1].key(RIGID, "whole")
    with pytest.raises(BadInputError, match="was changed"):
        whole_source(Dataset(noisy.folder), SPECS["rgb"]).whole([RIGID])


def test_the_cut_keeps_frames_and_contacts_up_to_number_44() -> None:
    scene = make_scene(RIGID, False)
    motion = make_trajectory(scene)
    frames = np.array([0, 43, 44, 45, 46], np.int32)
    rows = np.arange(15, dtype=np.float32).reshape(5, 3)
    contacts = Contacts(frames, np.tile(np.int32([[0, 1]]), (5, 1)), rows, -rows, rows[:, 0])
    motion = dataclasses.replace(motion, contacts=contacts)
    cut = cut_to_observed(scene, motion)
    assert cut.contacts.frame.tolist() == [0, 43, 44]
    np.testing.assert_array_equal(cut.contacts.point, rows[:3])
    np.testing.assert_array_equal(cut.contacts.normal, -rows[:3])
    assert len(cut) == 45 and not cut.completed
    np.testing.assert_array_equal(cut.positions[-1], motion.positions[44])


def reachable(start: object) -> Iterator[object]:
    """Yield all objects that attributes, items and bases of arrays lead to from ``start``."""
    seen: dict[int, object] = {}
    waiting = [start]
    while waiting:
        thing = waiting.pop()
        if id(thing) in seen or isinstance(thing, type):
            continue
        seen[id(thing)] = thing
        yield thing
        if isinstance(thing, np.ndarray):
            waiting.append(thing.base)
        elif isinstance(thing, dict):
            waiting += [*thing, *thing.values()]
        elif isinstance(thing, tuple | list | set | frozenset):
            waiting += thing
        elif type(thing).__module__.startswith("physion"):
            names = {*getattr(thing, "__dict__", {})}
            for kind in type(thing).__mro__:
                names |= {*getattr(kind, "__slots__", ())}
            waiting += [getattr(thing, name, None) for name in names]
            # Python 3.11.2 makes a wrong __weakref__ of a dataclass with slots.
            bound = [
                getattr(thing, name, None)
                for name in dir(type(thing))
                if name not in ("__dict__", "__weakref__")
            ]
            for function in bound:
                cells = getattr(function, "__closure__", None) or ()
                waiting += [cell.cell_contents for cell in cells]


@pytest.mark.parametrize("name", sorted(SPECS))
@pytest.mark.parametrize("rendered", [False, True])
def test_no_attribute_leads_to_later_frames(made: Dataset, name: str, rendered: bool) -> None:
    source = observed_source(made, SPECS[name], rendered=rendered)
    batch = source.context([RIGID, CLOTH])
    full = {str(paths.movie) for paths in map(made.paths, made.trials())}
    full |= {str(paths.free_movie) for paths in map(made.paths, made.trials())}
    full |= {*made.index["movie_sha256"], *made.index["free_movie_sha256"], *made.index["movie"]}
    files = {str(made.paths(trial).trial_file) for trial in made.trials()}
    things = [*reachable(source), *reachable(batch)]
    assert len(things) > 20
    for thing in things:
        assert not isinstance(thing, Dataset | Trial | WholeSource)
        if isinstance(thing, np.ndarray) and thing.ndim:
            assert thing.shape[0] != FRAMES and thing.nbytes != FRAMES
        if isinstance(thing, Trajectory):
            assert len(thing) == OBSERVED_FRAMES
            assert (thing.contacts.frame < OBSERVED_FRAMES).all()
        if isinstance(thing, str | Path):
            assert str(thing) not in full
            if name == "rgb" and not rendered:
                assert str(thing) not in files


def test_the_search_finds_later_frames(made: Dataset) -> None:
    trial = made.trial(RIGID)
    whole = Motion(trial.scene, trial.trajectory)
    view = cut_to_observed(trial.scene, trial.trajectory)
    for thing in (whole, Motion(trial.scene, view), whole_source(made, SPECS["rgb"])):
        found = [*reachable(thing)]
        arrays = [t for t in found if isinstance(t, np.ndarray) and t.ndim]
        paths = [t for t in found if isinstance(t, Path)]
        full = [path for path in paths if path == made.paths(RIGID).movie]
        assert full or any(len(array) == FRAMES for array in arrays)
    arrays = [thing for thing in reachable(cut_motion(whole)) if isinstance(thing, np.ndarray)]
    assert len(arrays) > 10 and all(array.base is None for array in arrays)


@pytest.mark.parametrize("rendered", [False, True])
def test_an_observed_source_has_no_request_for_later_frames(made: Dataset, rendered: bool) -> None:
    source: Any = observed_source(made, SPECS["rgb"], rendered=rendered)
    for name in ("window", "whole", "length"):
        assert not hasattr(source, name)
    with pytest.raises(FutureFrameError, match="no part 'whole'"):
        source.key(RIGID, "whole")


def test_a_context_with_frame_45_is_refused(made: Dataset) -> None:
    class Leaking(Spec):
        def context_frames(self) -> tuple[int, ...]:
            return 0, 45

    for inputs in (("rgb",), ("ids",), ("state",)):
        source: ObservedSource = observed_source(made, Leaking(inputs=inputs))
        with pytest.raises(FutureFrameError, match="frame 45 comes after the observed part"):
            source.context([RIGID])


def test_observed_batches_need_no_full_movie(made: Dataset, tmp_path: Path) -> None:
    shutil.copytree(made.folder, tmp_path / "copy")
    copy = Dataset(tmp_path / "copy")
    for path in (copy.paths(RIGID).movie, copy.paths(RIGID).free_movie):
        path.unlink()
    assert observed_source(copy, SPECS["rgb"]).context([RIGID]).rgb.any()
    with pytest.raises(BadInputError, match="missing"):
        whole_source(copy, SPECS["rgb"]).whole([RIGID])


def test_an_observed_movie_that_shows_the_future_is_refused(made: Dataset, tmp_path: Path) -> None:
    shutil.copytree(made.folder, tmp_path / "copy")
    copy = Dataset(tmp_path / "copy")
    paths = copy.paths(RIGID)
    paths.observed_movie.write_bytes(paths.movie.read_bytes())
    with pytest.raises(BadInputError, match=r"50 frames .* not 45"):
        observed_source(Dataset(copy.folder, verify=False), SPECS["rgb"]).context([RIGID])


def test_no_scene_tells_the_answer_by_its_parameters(made: Dataset, tmp_path: Path) -> None:
    shutil.copytree(made.folder, tmp_path / "set")
    known = {"pair": {"first": 0, "then": 1}, "base_contact": True, "mass": 2.0}
    known |= {"whatif": "cue-mass.far.light"}
    path = Dataset(tmp_path / "set").paths(RIGID).trial_file
    trial = Trial.open(path)
    scene = dataclasses.replace(trial.scene, parameters=known)
    write_trial(path, trial.metadata, scene, trial.trajectory, trial.labels, trial.ids)
    changed = Dataset(tmp_path / "set", verify=False)
    assert changed.trial(RIGID).scene.parameters == known
    observed = observed_source(changed, SPECS["state"]).context([RIGID])
    whole = whole_source(changed, SPECS["state"]).whole([RIGID])
    for batch in (observed, whole):
        assert batch.state is not None and dict(batch.state[0].scene.parameters) == {"mass": 2.0}


def test_a_file_is_digested_once_and_refused_if_it_changed(
    made: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Dataset(shutil.copytree(made.folder, tmp_path / "copy"))
    files, digested = copy.files("trial_file"), []

    def counted(motion: Motion) -> str:
        digested.append(motion.scene.name)
        return motion_digest(motion)

    monkeypatch.setattr("physion.clips.states.motion_digest", counted)
    first, *_ = files
    for observed in (True, False, True, False):
        motions = TrialMotions(files, observed=observed)
        assert digest_in(motions, first) == motion_digest(motions[first])
        assert digest_in(dict(motions), first) == motion_digest(motions[first])
    # Twice from the file, cut and whole, and each time from the plain mapping.
    assert len(digested) == 2 + 4
    files[first].path.write_bytes(b"other")
    with pytest.raises(BadInputError, match="changed"):
        digest_in(TrialMotions(files, observed=True), first)
