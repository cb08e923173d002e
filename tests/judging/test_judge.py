"""Judgement of generated movies: true ones, corrupted ones, planted faults, bad input."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage
from scipy.spatial import ConvexHull

from physion.cli.main import main as cli
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError
from physion.judging.ground import Ground
from physion.judging.judge import judge
from physion.judging.measure import KnownMovie, measure, reference_of
from physion.judging.track import AGENT, PATIENT, Tracker, hsv, shift_between
from physion.numerics.rotations import rotation_matrix
from physion.rendering.camera import View
from physion.scenes.scene import Body, Camera, Roles, Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.dataset import Dataset
from physion.trials.index import write_index
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset
from physion.trials.share.conditioning import export_conditioning
from physion.trials.video import encode_movie, read_frames

U8 = NDArray[np.uint8]
SIDE, FIRST, SEEDS = 128, 45, 6


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A trial of Collide and one of Drop, in red and yellow."""
    folder = tmp_path_factory.mktemp("trials")
    tasks = plan_dataset("judged", ["collide", "drop"], {"testing": 1})
    settings = GenerateSettings(width=SIDE, height=SIDE, look="redyellow", jitters=0)
    assert not make_trials(folder, tasks, settings, executor=SerialExecutor()).failed
    return Dataset(folder)


@pytest.fixture(scope="module")
def generated(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """True continuations of Collide, brightened a little for each seed; none is right of Drop."""
    folder = tmp_path_factory.mktemp("movies")
    good, bad = (dataset.trials(scenario=name)[0] for name in ("collide", "drop"))
    for seed in range(SEEDS):
        (folder / str(seed)).mkdir()
        frames = np.minimum(dataset.frames(good)[FIRST:], 250) + np.uint8(seed)
        (folder / str(seed) / f"{good}.mp4").write_bytes(encode_movie(frames))
    frames = dataset.frames(bad)[FIRST:]
    movies = {
        "0": b"no movie",
        "1": encode_movie(frames[:50]),
        "2": encode_movie(frames[:, :64]),
        "3": encode_movie(frames, rate=300),
    }
    movies["4"] = movies["1"]
    for name, movie in movies.items():
        (folder / name / f"{bad}.mp4").write_bytes(movie)
    write_card(folder)
    return folder


def write_card(folder: Path, **values: Any) -> None:
    folder.mkdir(exist_ok=True)
    card = {
        "protocol": "physion-judge-1",
        "model": "the truth",
        "conditioning": "last frame",
        "prompt": "",
        "first_frame": FIRST,
        "seeds": [str(seed) for seed in range(SEEDS)],
    }
    (folder / "card.json").write_text(json.dumps(card | values))


@pytest.mark.slow
def test_movies_are_judged_and_bad_ones_named(
    dataset: Dataset, generated: Path, tmp_path: Path
) -> None:
    good, bad = (dataset.trials(scenario=name)[0] for name in ("collide", "drop"))
    done = judge(generated, dataset.folder, tmp_path, executor=SerialExecutor())
    assert not done.complete and set(done.missing["trial"]) == {bad}
    why = dict(zip(done.missing["seed"], done.missing["status"], strict=True))
    assert "cannot be read" in why["0"]
    assert "lasts 1.67 s; the trial lasts" in why["1"]
    assert "another shape" in why["2"]
    assert "a rate that is not 4 to 240" in why["3"]
    assert why["4"] == "the same file as of seed 1"
    assert why["5"] == "missing"
    table = done.seeds.set_index("seed")
    assert (table["right"].drop("sd") == 0.5).all() and table.loc["sd", "right"] == 0
    assert (table["on_path"].drop("sd") > 0.9).all() and table.loc["mean", "movies"] == 1
    predictions = pd.read_csv(done.paths["predictions"]).set_index("stimulus")
    truth = dataset.index.set_index("trial")["contact"]
    assert predictions.loc[good, "p_contact"] == truth[good]
    assert predictions.loc[bad, "p_contact"] == 1 - truth[bad]
    tracks = pd.read_csv(done.paths["tracks"])
    assert len(tracks) == SEEDS * (len(dataset.frames(good)) - FIRST)
    assert (tracks["distance"] - tracks["true_distance"]).abs().median() < 1

    (one,) = (tmp_path / "judged").glob(f"{good}-*.json")
    made = one.stat().st_mtime_ns
    again = judge(generated, dataset.folder, tmp_path, scenario="collide")
    assert again.complete and again.seeds["right"][0] == 1 and one.stat().st_mtime_ns == made


@pytest.mark.parametrize("known", [True, pd.NA])
def test_trials_with_a_contact_in_the_observed_part_do_not_count(
    known: Any, dataset: Dataset, generated: Path, tmp_path: Path
) -> None:
    """What is seen in Collide would be wrong: the answer was shown."""
    folder = tmp_path / "trials"
    shutil.copytree(dataset.folder, folder)
    observed = pd.array([False] * len(dataset.index), "boolean")
    observed[(dataset.index["scenario"] == "collide").to_numpy()] = known
    write_index(folder, dataset.index.assign(observed_contact=observed))
    done = judge(generated, folder, tmp_path / "out", executor=SerialExecutor())
    assert (done.seeds.set_index("seed")["right"] == 0).all(), "movies of Drop are missing"
    assert done.movies.groupby("scenario")["observed_contact"].all().to_dict() == {
        "collide": True, "drop": False,
    }  # fmt: skip
    predictions = pd.read_csv(done.paths["predictions"])
    assert list(predictions["stimulus"]) == dataset.trials(scenario="drop")
    (line,) = done.warnings
    assert line.startswith("1 trial with a contact in the observed part, or where that")
    with pytest.raises(BadInputError, match="observed part of every chosen trial"):
        judge(generated, folder, tmp_path / "out", scenario="collide")


def test_an_agent_that_stays_away_does_not_touch_again(dataset: Dataset) -> None:
    """The true one touched before; in the movie nothing moves after the observed part."""
    (trial,) = dataset.trials(scenario="drop")
    frames = dataset.frames(trial)
    known = replace(reference(dataset, trial), contacts=np.arange(20, 40, dtype=np.int32))
    still = np.repeat(frames[:1], len(frames) - FIRST, axis=0)
    assert not measure(still, 30, FIRST, known)[0]["contact"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"protocol": "physion-judge-0"}, "this package judges by 'physion-judge-1'"),
        ({"model": " "}, "model is empty"),
        ({"seeds": ["0", "0"]}, "seeds must be names that differ"),
        ({"seeds": ["../x"]}, "is not the name of a folder"),
        ({"seeds": ["7"]}, "holds no movie of these trials; the first one is looked for in .*7"),
        ({"first_frame": -1}, "below 0"),
        ({"first_frame": "45"}, "first_frame must be a whole number"),
        ({"other": 1}, "unknown key 'other'"),
    ],
)
def test_bad_cards_are_refused(
    dataset: Dataset, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    write_card(tmp_path, **change)
    with pytest.raises(BadInputError, match=message):
        judge(tmp_path, dataset.folder, tmp_path / "out")


def test_movies_that_nobody_asked_for_are_named(dataset: Dataset, tmp_path: Path) -> None:
    (trial,) = dataset.trials(scenario="collide")
    folder = tmp_path / "movies"
    write_card(folder, seeds=["0", "1"])
    others = [f"0/{trial}.webm", "0/collide_testing_0001.mp4", "2/any.mp4", "3/a.mov", "whole.mp4"]
    for name in [f"0/{trial}.mp4", "0/notes.txt", "notes/readme.txt", ".cache/old.mp4", *others]:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"no movie")
    done = judge(folder, dataset.folder, folder / "out", scenario="collide")
    assert done.unknown == (
        f"0/{trial}.webm", "0/collide_testing_0001.mp4", "2/", "3/", "whole.mp4"
    )  # fmt: skip
    (line,) = done.warnings
    assert line.endswith(f"(5): {', '.join(done.unknown)}")
    (folder / "2" / "any.mp4").unlink()
    (folder / "6").mkdir()
    (folder / "6" / "any.mp4").touch()
    (folder / "4.mp4").touch()
    (folder / "5.mp4").touch()
    (line,) = judge(folder, dataset.folder, folder / "out", scenario="collide").warnings
    assert "(7): " in line and line.endswith("4.mp4, 5.mp4, ...")


def test_the_request_tells_no_outcome(dataset: Dataset, tmp_path: Path) -> None:
    readme, listing, card = export_conditioning(dataset.folder, tmp_path)
    table = pd.read_csv(listing)
    assert list(table["trial"]) == sorted(dataset.trials()) and set(table["first_frame"]) == {45}
    assert set(table) == {
        "trial", "image", "movie", "prompt", "width", "height", "rate", "first_frame", "frames"
    }  # fmt: skip
    for row in table.itertuples():
        observed = read_frames(tmp_path / str(row.movie))
        assert len(observed) == FIRST
        np.testing.assert_array_equal(Image.open(tmp_path / str(row.image)), observed[-1])
    assert json.loads(card.read_text())["seeds"] == ["0", "1", "2", "3"]
    assert "4 movies of each trial" in readme.read_text()


@pytest.mark.nightly
@pytest.mark.slow
def test_the_verb_writes_page_and_comparison(
    dataset: Dataset, generated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["judge", str(generated), str(dataset.folder), "--out", str(tmp_path / "out")]
    arguments += ["--workers", "1"]
    other = generated / "0" / "other.mp4"
    other.touch()
    assert cli(arguments) == 1
    caught = capsys.readouterr()
    printed = caught.out
    assert "no such trial (1): 0/other.mp4" in caught.err
    assert "the truth: not complete, 6 of 12 movies judged by physion-judge-1" in printed
    assert "missing: drop_testing_0000, seed 0" in printed and "and 1 more" in printed
    page = (tmp_path / "out" / "judge.html").read_text()
    assert page.count("<video") == 1 and "Truly" in page and "which count as wrong" in page
    assert cli([*arguments, "--scenario", "collide", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["complete"] and len(values["movies"]) == SEEDS
    assert values["unknown"] == ["0/other.mp4"]
    other.unlink()


def turned(frames: U8, part: float) -> U8:
    """Frames whose hues are shifted by a part of the circle (rotation of the RGB cube)."""
    angle = 2 * np.pi * part
    axis = np.ones(3) / np.sqrt(3)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return np.asarray(np.clip(frames @ matrix.T, 0, 255).astype(np.uint8))


def encoded(frames: U8) -> U8:
    with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
        file.write(encode_movie(frames, crf=32))
        file.flush()
        return read_frames(Path(file.name))


def reference(dataset: Dataset, trial: str) -> KnownMovie:
    return reference_of(dataset.trial(trial), dataset.frames(trial), 30)


CORRUPTIONS: dict[str, Callable[[U8], U8]] = {
    "clean": lambda frames: frames,
    "low rate": encoded,
    "blurred": lambda frames: ndimage.gaussian_filter(frames, (0, 0.8, 0.8, 0)),
    "noisy": lambda frames: np.clip(
        frames + np.random.default_rng(0).normal(0, 10, frames.shape), 0, 255
    ).astype(np.uint8),
    "hue": lambda frames: turned(frames, 0.1),
    "moved": lambda frames: np.roll(frames, (4, -5), (1, 2)),
    "half the rate": lambda frames: frames[::2],
}


@pytest.mark.slow
@pytest.mark.parametrize("change", CORRUPTIONS)
def test_the_outcome_is_seen_through_corruptions(dataset: Dataset, change: str) -> None:
    (trial,) = dataset.trials(scenario="collide")
    known, movie = reference(dataset, trial), dataset.frames(trial)[FIRST:]
    labels = dataset.trial(trial).known_labels()
    rate = 15 if change == "half the rate" else 30
    found, _ = measure(CORRUPTIONS[change](movie), rate, FIRST, known)
    assert found["contact"] == labels.contact
    assert found["trajectory"] < 1.5 and found["agent_seen"] > 0.9
    if labels.first_frame is not None:
        assert abs(found["contact_frame"] - labels.first_frame) <= 4
    assert found["shift"] == pytest.approx(np.hypot(4, 5) if change == "moved" else 0)
    assert found["hue"] == pytest.approx(36 if change == "hue" else 0, abs=8)


@pytest.mark.slow
def test_planted_faults_are_in_the_right_measures(dataset: Dataset) -> None:
    (trial, *_) = dataset.trials(scenario="drop")
    frames = dataset.frames(trial)
    known = reference(dataset, trial)
    hue, saturation, _ = hsv(frames)
    red = (saturation > 0.5) & ((hue < 18) | (hue > 342))
    without = frames.copy()
    for frame, mask in zip(without, ndimage.binary_dilation(red, np.ones((1, 5, 5))), strict=True):
        frame[mask] = (60, 70, 90)
    middle = (len(frames) + FIRST) // 2
    teleported = frames.copy()
    teleported[middle:] = without[middle:]
    teleported[middle:, 5:15, 5:15] = (180, 10, 10)
    vanished = np.concatenate([frames[:middle], without[middle:]])
    frozen = np.concatenate(
        [frames[:FIRST], np.repeat(frames[FIRST : FIRST + 1], len(frames) - FIRST, axis=0)]
    )
    swapped = frames.copy()
    yellow = (saturation > 0.5) & (np.abs(hue - 60) < 17)
    swapped[yellow], swapped[red] = (180, 10, 10), (220, 220, 20)
    movies = {"clean": frames, "freeze": frozen, "vanish": vanished, "teleport": teleported,
              "swap": swapped}  # fmt: skip
    table = pd.DataFrame(
        {name: measure(movie[FIRST:], 30, FIRST, known)[0] for name, movie in movies.items()}
    ).T
    assert table["trajectory"].astype(float).idxmin() == "clean"
    assert table["agent_seen"].astype(float).idxmin() in ("vanish", "swap")
    assert table.loc["vanish", "agent_seen"] < 0.7 < table.loc["clean", "agent_seen"]
    assert table.loc["teleport", "jump"] > 10 > table.loc["clean", "jump"]
    assert table.loc["freeze", "travelled"] < 0.2 < 0.9 < table.loc["clean", "travelled"]
    assert table.loc["swap", "patient_size"] > table.loc["clean", "patient_size"] + 0.5


@pytest.mark.parametrize("angle", [0.0, 20.0, 65.0])
@pytest.mark.parametrize("cut", [0.0, 0.4])
def test_an_outline_says_where_the_agent_stands(angle: float, cut: float) -> None:
    """A cuboid is drawn by its corners, with an edge on the patient or 5 cm next to it.

    A wall in front may hide the lower part of it.
    """
    half = np.deg2rad(angle) / 2
    rotation = (float(np.cos(half)), 0.0, 0.0, float(np.sin(half)))
    agent = Body("agent", "cube", (0.0, 0.0, 0.0), (0.2, 0.3, 0.4), rotation=rotation)
    patient = Body("patient", "cube", (0.0, 0.0, 0.0), (1.0, 0.6, 0.01))
    camera = Camera((0.3, -2.2, 1.3), (0.0, 0.0, 0.1))
    wall = Body("wall", "cube", (0.3, -1.2, 0.0), (1.0, 0.1, 0.5), kinematic=True, scenery=True)
    scene = Scene(
        name="stands", scenario="collide", camera=camera, roles=Roles("agent", "patient"),
        bodies=(agent, patient, wall),
    )  # fmt: skip
    base = shape("cube").mesh.vertices * agent.scale @ rotation_matrix(np.array(rotation)).T
    across = np.ptp(base[:, 0]) / 2
    for gap, touches in ((-0.05, True), (0.05, False), (-0.3, True), (0.4, False)):
        corners = base + np.array([0.5 + across + gap, 0.0, 0.01])
        pixels, _ = View(camera, 256, 256).project(corners)
        picture = Image.new("L", (256, 256))
        around = pixels[ConvexHull(pixels).vertices]
        ImageDraw.Draw(picture).polygon([tuple(p - 0.5) for p in around], fill=1)
        mask = np.asarray(picture) > 0
        rows = np.flatnonzero(mask.any(axis=1))
        ids = np.zeros((256, 256), np.int16)
        ids[int(rows[-1] + 1 - cut * len(rows)) :] = 3
        mask &= ids == 0
        ground = Ground.of(scene, ids)
        assert ground is not None
        outline = np.argwhere(mask & ~ndimage.binary_erosion(mask))[:, ::-1].astype(float)
        assert ground.touches(outline) == touches, gap


def test_the_agent_is_looked_for_where_it_was_last() -> None:
    """A red rest of it is left there, and there is red elsewhere, of 25 or of 9 pixels."""
    first = np.full((64, 64, 3), 90, np.uint8)
    roles = np.zeros((64, 64), np.uint8)
    roles[10:18, 10:18], roles[40:50, 5:15] = AGENT, PATIENT
    first[roles == AGENT], first[roles == PATIENT] = (200, 20, 20), (220, 220, 20)
    hidden = np.where((roles == AGENT)[..., None], np.uint8(90), first)
    rest, other, small = hidden.copy(), hidden.copy(), hidden.copy()
    rest[12:15, 12:15] = other[50:55, 50:55] = small[50:53, 50:53] = (200, 20, 20)
    rest[50:55, 50:55] = (200, 20, 20)
    place = np.array([13.5, 13.5]), 8.0, 64.0
    for picture, center in ((rest, (13, 13)), (other, (52, 52)), (small, (np.nan, np.nan))):
        agent, _ = Tracker(first, roles, place).see(picture)
        np.testing.assert_array_equal(agent.center, center)


def test_shifts_are_found_only_where_they_help() -> None:
    rng = np.random.default_rng(1)
    picture = ndimage.gaussian_filter(rng.integers(0, 255, (64, 64, 3)), (1, 1, 0)).astype(np.uint8)
    assert shift_between(np.roll(picture, (3, -4), (0, 1)), picture) == (-4, 3)
    assert shift_between(picture, picture) == (0, 0)
    other = rng.integers(0, 255, (64, 64, 3)).astype(np.uint8)
    assert shift_between(other, picture) == (0, 0)
