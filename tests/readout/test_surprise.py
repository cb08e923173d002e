"""The impossible movie of a pair surprises more: surprises, and what counts of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn

import physion
from physion.cli.evaluate import _print_whatif
from physion.cli.main import main
from physion.clips.batch import Batch, Motion, Provenance, Rollout, Spec
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, PhysionError
from physion.models.build import build_model
from physion.models.interface import Model
from physion.models.noisy_simulation import NoisySimulation
from physion.physics.engine import simulate
from physion.readout.surprise import COLUMNS, pixel_statistics, surprise, surprise_scores
from physion.readout.whatif import causes, causes_line, whatif_scores
from physion.report.viewer import facts as viewer_facts
from physion.trials.dataset import Dataset
from physion.trials.making.pairs import Pair, is_pair
from physion.trials.making.plan import PAIR, GenerateSettings
from physion.trials.official.export_folder import export_official
from physion.trials.share.items import items_of


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pairs")
    physion.generate(
        folder, "dominoes", 2, pairs=["vanish", "teleport"],
        settings=GenerateSettings(width=32, height=32, jitters=0, movies=False),
        executor=SerialExecutor(),
    )  # fmt: skip
    return folder


class Bright(Model):
    """Features are mean colours; nothing changes in what it imagines."""

    spec = Spec(image_size=32, context=3)

    def provenance(self) -> Provenance:
        return Provenance("bright", "none")

    def digest(self) -> str:
        return "ab" * 32

    def encode(self, batch: Batch) -> Any:
        return np.asarray(batch.rgb.mean(axis=(2, 3)) / 255, np.float32)

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        # What is random may be drawn by name: both movies of a pair are called alike.
        assert context.trials[0].startswith("dominoes") and "+" not in context.trials[0]
        last = context.features[:, -1][:, None, None]
        return Rollout(features=np.repeat(np.repeat(last, samples, 1), context.future, 2))


class Knows(Bright):
    """It knows which movies are impossible; what it receives does not say so."""

    spec = Spec(inputs=("state",))

    def __init__(self, sign: float, folder: Path) -> None:
        self.sign, self.dataset = sign, Dataset(folder)

    def provenance(self) -> Provenance:
        return Provenance(f"knows {self.sign}", "none")

    def surprise(self, batch: Batch) -> Any:
        assert batch.state is not None
        found = np.zeros(batch.frames.shape)
        for row, (name, motion) in enumerate(zip(batch.trials, batch.state, strict=True)):
            pair = Pair.of(self.dataset.trial(name).scene)
            assert pair is not None and Pair.of(motion.scene) is None
            assert not {PAIR, "possible", "worlds"} & motion.scene.parameters.keys()
            found[row, batch.frames[row] >= pair.start] = self.sign * (not pair.possible)
        return found


class Losing(nn.Module, Bright):
    """A network whose loss is the squared change of the mean picture within a window of two."""

    window = 2
    encode = imagine = None  # type: ignore[assignment]

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones(()))

    def provenance(self) -> Provenance:
        return Provenance("losing", "random")

    def loss(self, batch: Batch) -> Any:
        mean = batch.rgb.float().mean(dim=(2, 3)) / 255
        return {"loss": (self.factor * (mean[:, 1] - mean[:, 0])).pow(2).mean()}


def test_who_knows_is_right_and_who_has_no_idea_is_half_right(pairs: Path, tmp_path: Path) -> None:
    table = surprise([Knows(sign, pairs) for sign in (1.0, -1.0, 0.0)], pairs, tmp_path).table
    names = [name for name in Dataset(pairs).trials() if is_pair(name)]
    assert list(table.columns) == list(COLUMNS) and len(table) == 3 * len(names)
    scores = surprise_scores([table]).set_index(["model", "kind", "hidden"])
    for sign, expected in ((1.0, 1.0), (-1.0, 0.0), (0.0, 0.5)):
        row = scores.loc[f"knows {sign}", "all", "all"]
        assert row["pairs"] == len(names) / 2
        # The mean sees a surprise below 0 as less, the largest sees the frames before, with 0.
        assert row["mean"] == expected and row["largest"] == max(expected, 0.5)


@pytest.mark.slow
def test_imagined_features_are_compared_with_the_next_frame(pairs: Path, tmp_path: Path) -> None:
    table = surprise(Bright(), pairs, tmp_path).table.set_index("stimulus")
    losses = surprise(Losing(), pairs, tmp_path).table.set_index("stimulus")
    dataset = Dataset(pairs)
    name = str(table.index[0])
    renderer = dataset.trial(name).renderer(32, 32)
    frames = range(2, len(dataset.trial(name).trajectory), 6)
    pictures = [np.asarray(renderer.render(frame).color) for frame in frames]
    means = np.array([picture.mean(axis=(0, 1)) / 255 for picture in pictures])
    errors = np.append(0.0, (np.diff(means, axis=0) ** 2).mean(axis=1))
    assert table.loc[name, "mean"] == pytest.approx(errors.mean(), rel=1e-3)
    assert table.loc[name, "largest"] == pytest.approx(errors.max(), rel=1e-3)
    # The same, said by a loss.
    assert losses.loc[name, "mean"] == pytest.approx(errors.mean(), rel=1e-3)


class Breaks(Bright):
    """It fails on every clip."""

    def provenance(self) -> Provenance:
        return Provenance("breaks", "none")

    def encode(self, batch: Batch) -> Any:
        raise ValueError("no features today")


@pytest.mark.slow
def test_a_model_that_fails_does_not_stop_the_others(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = surprise([Breaks(), Bright()], pairs, tmp_path)
    assert set(done.table["model"]) == {"bright"}
    assert list(done.failed) == ["breaks"] and "no features today" in done.failed["breaks"]
    with pytest.raises(PhysionError, match="no features today"):
        surprise(Breaks(), pairs, tmp_path)
    models = f"constant-motion,{__file__}:Breaks"
    arguments = ["evaluate", models, str(pairs), "--surprise", "--rendered", "--out", str(tmp_path)]
    assert main(arguments) == 1
    printed = capsys.readouterr().out
    assert "Breaks: model 'breaks': encode raised ValueError" in printed
    assert "constant-motion" in printed


def test_what_is_known_is_not_computed_again(pairs: Path, tmp_path: Path) -> None:
    first = surprise(Bright(), pairs, tmp_path).table
    asked: list[str] = []
    again = surprise(
        Bright(), pairs, tmp_path, progress=lambda what, done, total: asked.append(what)
    ).table
    assert not asked
    pd.testing.assert_frame_equal(first, again)


def test_surprises_by_other_colours_are_computed_anew(pairs: Path, tmp_path: Path) -> None:
    changed = Dataset(pairs)
    changed.index["look"] = "free"
    for dataset in (Dataset(pairs), changed):
        surprise(Knows(1.0, pairs), dataset, tmp_path)
    assert len(list(tmp_path.rglob("knows*.csv"))) == 2


@pytest.mark.slow
@pytest.mark.parametrize("column", ["look", "movie_sha256"])
def test_pixel_statistics_of_other_movies_are_computed_anew(
    pairs: Path, tmp_path: Path, column: str
) -> None:
    changed = Dataset(pairs)
    changed.index[column] = "free"
    for dataset in (Dataset(pairs), changed):
        pixel_statistics(dataset, tmp_path, rendered=True)
    assert len(list(tmp_path.rglob("pixel-statistics*.csv"))) == 2


@pytest.mark.slow
def test_surprises_with_other_options_are_computed_anew(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(self: Any, batch: Batch) -> Any:
        return np.full(batch.frames.shape, float(self.samples))

    monkeypatch.setattr(NoisySimulation, "surprise", found)
    for samples in (2, 3):
        table = surprise("noisy-simulation", pairs, tmp_path, options={"samples": samples}).table
        assert set(table["mean"]) == {samples}


@pytest.mark.parametrize("option", ["--dry-run", "--check", "--fit=other"])
def test_options_that_do_not_apply_to_surprise_are_refused(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "chance", "unused", "--surprise", option]) == 2
    assert f"{option.split('=')[0]} does not apply to --surprise" in capsys.readouterr().err


def test_the_viewer_says_which_movies_are_impossible(pairs: Path) -> None:
    dataset = Dataset(pairs)
    said = {}
    for name in dataset.trials():
        trial = dataset.trial(name)
        rows = {table["title"]: dict(table["rows"]) for table in viewer_facts.tables(trial)
                if not table["header"]}  # fmt: skip
        assert not [key for key in rows["Parameters of the scenario"] if "pair" in key]
        said[name] = viewer_facts.card(trial)["pair"], rows.get("Pair", {}).get("possible", "")
    for name, (badge, possible) in said.items():
        if not is_pair(name):
            assert (badge, possible) == ("", "")
            continue
        start = dataset.trial(name).scene.parameters[PAIR]["start"]
        kind = name.rpartition("pair.")[2].rpartition(".")[0]
        word = "possible" if possible == "yes" else f"impossible at frame {start}"
        assert badge in (f"{kind}: {word}", f"{kind}: {word}, behind a screen")
    assert [answer for _, answer in said.values()].count("no") == (len(said) - 2) / 2


@pytest.mark.slow
def test_questions_and_exports_leave_pairs_out(pairs: Path, tmp_path: Path) -> None:
    rest = [name for name in Dataset(pairs).trials() if not is_pair(name)]
    assert {item.trial for item in items_of(Dataset(pairs), split="testing")} == set(rest)
    report = export_official(pairs, tmp_path, layout="hdf5s", images=False)
    assert set(report.made) == set(rest)


def test_ties_count_half_and_errors_are_over_trials() -> None:
    rows = [
        ("m", "none", "drop", f"{base}{first}{possible}", base, "vanish", False, first, possible,
         value, value)
        for base, first, possible, value in (
            ("a", 0, True, 1.0), ("a", 0, False, 2.0), ("a", 1, True, 1.0), ("a", 1, False, 1.0),
            ("b", 0, True, 3.0), ("b", 0, False, 2.0),
        )
    ]  # fmt: skip
    scores = surprise_scores([pd.DataFrame(rows, columns=list(COLUMNS))])
    row = scores[(scores["kind"] == "all") & (scores["hidden"] == "all")].iloc[0]
    assert row["pairs"] == 3 and row["mean"] == pytest.approx((1 + 0.5 + 0) / 3)
    # Residuals of trial a: (1 - .5) + (.5 - .5), of trial b: 0 - .5; se^2 = 2/1 (.25 + .25) / 9.
    assert row["mean_se"] == pytest.approx(1 / 3)


def _clip(jump: float) -> tuple[Batch, int]:
    """Return a clip of a motion in which the agent jumps by ``jump`` metres at frame 60."""
    scene = physion.sample_scene("dominoes", 0)
    path = simulate(scene, frames=80)
    row = scene.index(scene.roles.agent)
    moved = path.positions.copy()
    moved[60:, row, 0] += jump
    frames = np.arange(2, 80, 6)[None]
    motion = Motion(scene, replace(path, positions=moved))
    return Batch(("one",), frames, np.ones(frames.shape, bool), state=(motion,)), 10


@pytest.mark.parametrize("name", ["constant-motion", "noisy-simulation", "gns", "dpi"])
def test_models_of_motion_are_surprised_by_a_jump(name: str) -> None:
    model = build_model(name, **({"samples": 3} if name == "noisy-simulation" else {}))
    (still, step), (jumped, _) = _clip(0.0), _clip(0.6)
    calm, found = model.surprise(still)[0], model.surprise(jumped)[0]
    assert calm.shape == found.shape == (13,)
    assert np.allclose(calm[:step], found[:step])
    assert int(np.argmax(found - calm)) == step
    if name == "constant-motion":
        # Nothing else moves then: the surprise is the jump.
        assert found[step] == pytest.approx(0.6, abs=0.02)
    if name == "noisy-simulation":
        # -log exp(-d^2 / 2 w^2) with d = .6 and w = .02, less what three samples miss by.
        assert found[step] == pytest.approx(450, rel=0.2)


def test_noisy_simulation_is_surprised_alike_before_movies_of_a_pair_differ() -> None:
    model, (clip, step) = build_model("noisy-simulation", samples=2), _clip(0.0)
    assert clip.state is not None
    found = []
    for number in range(2):
        scene = replace(clip.state[0].scene, name=f"a_trial+pair.teleport.{number}")
        motion = Motion(scene, clip.state[0].trajectory)
        start = clip.steps(np.arange(step // 2))
        found.append(model.surprise(replace(start, state=(motion,))))
    assert found[0].any() and np.array_equal(*found)


def test_a_dataset_without_pairs_and_a_model_without_surprise_are_refused(
    pairs: Path, tmp_path: Path
) -> None:
    with pytest.raises(BadInputError, match="has no surprise"):
        surprise("chance", pairs, tmp_path)
    plain = physion.generate(
        tmp_path / "plain", "drop", 1, executor=SerialExecutor(),
        settings=GenerateSettings(width=32, height=32, jitters=0, movies=False),
    )  # fmt: skip
    with pytest.raises(BadInputError, match="generate --pairs"):
        surprise(Bright(), plain, tmp_path)
    with pytest.raises(BadInputError, match="generate --pairs"):
        pixel_statistics(plain, tmp_path)


@pytest.mark.slow
def test_pixel_statistics_give_a_probability_for_each_movie(pairs: Path, tmp_path: Path) -> None:
    table = pixel_statistics(pairs, tmp_path)
    pd.testing.assert_frame_equal(pixel_statistics(pairs, tmp_path), table)
    assert table["mean"].between(0, 1).all()
    assert set(table["stimulus"]) == {name for name in Dataset(pairs).trials() if is_pair(name)}


# --- a trial and its variant --------------------------------------------------------------------


P = {
    # name: P(contact), outcome, contact in the observed part
    "a": (0.9, True, False),
    "a+remove.x": (0.2, False, False),  # changed, both right, moved rightly
    "a+remove.y": (0.8, False, False),  # changed, wrong, but moved rightly
    "a+mass.quarter": (0.7, True, False),  # equal, moved by .2
    "b": (0.4, True, False),
    "b+remove.x": (0.6, False, False),  # changed, both wrong, moved wrongly
    "b+remove.y": (0.4, False, False),  # changed, trial wrong, not moved
    "b+push.weaker": (0.4, True, False),  # equal, not moved, wrong
    "b+push.stronger": (0.9, True, True),  # left out
    "c": (0.9, True, True),  # left out with its variant
    "c+remove.x": (0.1, False, False),
    "d": (0.9, True, False),  # no variant
}


def table(model: str = "m", **changed: float) -> pd.DataFrame:
    rows = [
        {"model": model, "readout": "observed", "protocol": "", "seed": "", "stimulus": name,
         "p_contact": changed.get(name, p), "outcome": outcome, "observed_contact": early}
        for name, (p, outcome, early) in P.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_every_measure_is_counted_by_hand() -> None:
    scores = whatif_scores(table()).set_index("change")
    assert list(scores.index) == ["all", "mass", "push", "remove"]
    whole, removed = scores.loc["all"], scores.loc["remove"]
    assert (whole["pairs"], whole["changed"]) == (6, 4)
    assert (removed["pairs"], removed["changed"]) == (4, 4)
    assert whole["accuracy"] == pytest.approx(3 / 6)
    assert removed["accuracy"] == pytest.approx(2 / 4)
    assert removed["paired"] == pytest.approx(1 / 4)
    assert removed["moved"] == pytest.approx((1 + 1 + 0 + 0.5) / 4)
    assert whole["unmoved"] == pytest.approx((0.8 + 1) / 2)
    assert scores.loc["mass", "unmoved"] == pytest.approx(0.8)
    assert np.isnan(scores.loc["mass", "unmoved_se"]) and np.isnan(removed["unmoved"])
    # Two trials, a and b, with residual sums 1 and -1 of `moved` - .625 = .75: 2 / 1 * 2 * .75^2.
    assert removed["moved_se"] == pytest.approx(np.sqrt(2 * 2 * 0.75**2) / 4)


def test_a_body_without_which_the_outcome_is_another_is_a_cause() -> None:
    more = pd.DataFrame(
        [{"model": "m", "readout": "observed", "protocol": "", "seed": "", "stimulus": name,
          "p_contact": 0.5, "outcome": outcome, "observed_contact": False}
         for name, outcome in [("e", False), ("e+remove.x", True), ("e+remove.ramp.2", False)]]
    )  # fmt: skip
    found = causes(pd.concat([table(), table("other"), more]))
    assert [tuple(row) for row in found.itertuples(index=False)] == [
        ("a", "x", True, False, True),
        ("a", "y", True, False, True),
        ("b", "x", True, False, True),
        ("b", "y", True, False, True),
        ("e", "ramp.2", False, False, False),
        ("e", "x", False, True, True),
    ]
    assert list(found) == ["trial", "removed", "before", "after", "changed"]
    assert causes_line(found) == (
        "5 of 6 removals change the outcome: x 3 of 3, y 2 of 2, ramp.2 0 of 1"
    )
    assert causes(table().iloc[:0]).empty and list(causes(table().iloc[:0])) == list(found)


def test_trials_of_a_test_with_two_cues_are_a_pair() -> None:
    cues = {
        "e": (0.9, False, False),  # in no pair
        "e+cue-mass.0.0": (0.2, False, False),  # both right
        "e+cue-mass.0.1": (0.8, True, False),
        "e+cue-mass.1.0": (0.6, True, False),  # first right, moved wrongly
        "e+cue-mass.1.1": (0.7, False, False),
        "e+cue-friction.0.0": (0.5, True, True),  # left out with the other
        "e+cue-friction.0.1": (0.5, False, False),
        "f+cue-mass.1.0": (0.3, False, False),  # first right, not moved
        "f+cue-mass.1.1": (0.3, True, False),
    }
    rows = [
        {"model": "m", "readout": "observed", "protocol": "", "seed": "", "stimulus": name,
         "p_contact": p, "outcome": outcome, "observed_contact": early}
        for name, (p, outcome, early) in cues.items()
    ]  # fmt: skip
    scores = whatif_scores(pd.DataFrame(rows)).set_index("change")
    assert list(scores.index) == ["all", "cue-mass"]
    mass = scores.loc["cue-mass"]
    assert (mass["pairs"], mass["changed"]) == (3, 3)
    assert mass["accuracy"] == pytest.approx((1 + 0.5 + 0.5) / 3)
    assert mass["paired"] == pytest.approx(1 / 3)
    assert mass["moved"] == pytest.approx((1 + 0 + 0.5) / 3)
    # Two trials, e with two pairs and f with one, with residual sums 1/3 and -1/3 of `paired`.
    assert mass["paired_se"] == pytest.approx(np.sqrt(2 * 2 / 9) / 3)


def test_models_are_scored_apart_and_sets_without_variants_not() -> None:
    both = pd.concat([table("m"), table("always", **dict.fromkeys(P, 0.9))])
    scores = whatif_scores(both).set_index(["model", "change"])
    always = scores.loc["always", "all"]
    assert (always["paired"], always["moved"], always["unmoved"]) == (0, 0.5, 1)
    assert always["accuracy"] == pytest.approx(2 / 6)
    plain = table()
    assert whatif_scores(plain[~plain["stimulus"].str.contains("+", regex=False)]).empty
    assert list(whatif_scores(table().iloc[:0]).columns)[:5] == [
        "model", "readout", "protocol", "seed", "change",
    ]  # fmt: skip


def test_trainings_of_a_model_are_scored_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        {"model": "m", "init": init, "readout": "observed", "protocol": "one", "seed": "0",
         "dynamics_training_dataset": trained, "stimulus": name, "outcome": outcome,
         "p_contact": outcome == right, "observed_contact": False}
        for init, trained, right in (("random", "drop", True), ("random", "roll", False),
                                     ("x.pth", "drop", False))
        for name, outcome in (("a", True), ("a+remove.x", False))
    ]  # fmt: skip
    predictions = pd.DataFrame(rows).astype({"p_contact": float})
    scores = whatif_scores(predictions)
    scores = scores[scores["change"] == "all"]
    assert (scores["pairs"] == 1).all() and (scores["seed"] == "0").all()
    assert scores.groupby(["init", "dynamics_training_dataset"])["paired"].sum().to_dict() == {
        ("random", "drop"): 1, ("random", "roll"): 0, ("x.pth", "drop"): 0,
    }  # fmt: skip
    _print_whatif(predictions, tmp_path)
    header = capsys.readouterr().out.splitlines()[1].split()
    assert header[:4] == ["model", "readout", "init", "dynamics_training_dataset"]
    assert header[4] == "change", "the protocol is the same in all"


def test_initial_weights_of_a_model_are_surprised_apart() -> None:
    rows = [
        ("m", init, "drop", f"a{possible}", "a", "vanish", False, 0, possible, value, value)
        for init, possible, value in (
            ("random", True, 1.0), ("random", False, 2.0),
            ("x.pth", True, 2.0), ("x.pth", False, 1.0),
        )
    ]  # fmt: skip
    scores = surprise_scores([pd.DataFrame(rows, columns=list(COLUMNS))])
    scores = scores[(scores["kind"] == "all") & (scores["hidden"] == "all")]
    assert scores.set_index("init")["mean"].to_dict() == {"random": 1, "x.pth": 0}
