"""Evaluation of models, from movies to the table of predictions."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pandas as pd
import pytest
import timm
import torch
from safetensors.torch import save_file
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from physion.analysis.tables import check_predictions
from physion.clips.batch import Batch, Provenance, Rollout, Spec
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import digest_of
from physion.models.build import build_model, models
from physion.models.interface import TrainingSettings
from physion.readout.decisions import Decided
from physion.readout.evaluate import evaluate
from physion.readout.evaluation import EvaluatedModel, Evaluation
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import ChosenModel, EvaluationSettings, choose_models, plan_cells
from physion.readout.tables import (
    COLUMNS,
    MEAN,
    ScenarioPredictions,
    make_table,
    read_table,
    summarise_accuracy,
    write_table,
)
from physion.trials.dataset import Dataset
from physion.trials.index import write_index
from support.moving_dots import make_dots
from support.tiny_models import TINY
from support.trained_models import NextBrightness

QUICK = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-4, 1e-2, 1.0)))
OPTIONS: dict[str, Any] = {**TINY, "steps": 20}
COUNTS = {"training": 4, "readout": 24, "testing": 20}


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dots(tmp_path_factory.mktemp("dots"), COUNTS, ("collide", "drop"))


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def done(dots: Dataset, work: Path) -> Evaluation:
    return evaluate("frozen-encoder", dots, work, options=OPTIONS, settings=QUICK)


def accuracy(table: pd.DataFrame, protocol: str) -> float:
    rows = table[table["readout"] == protocol]
    return float(((rows["p_contact"] > 0.5) == rows["outcome"]).mean())


@pytest.mark.slow
def test_the_table_has_one_row_per_trial_and_readout(done: Evaluation, dots: Dataset) -> None:
    table = done.predictions
    assert tuple(table.columns) == COLUMNS
    assert len(table) == 3 * 2 * COUNTS["testing"]
    assert (table["init"] == "random").all()
    assert (table["inputs"] == "rgb").all()
    assert (table["model"] == "random-test_vit-mlp").all()
    assert set(table["readout"]) == {"full", "observed+simulated", "observed"}
    assert set(table["protocol"]) == {"all"} and set(table["seed"]) == {"0"}
    truth = dots.index.set_index("trial")["contact"]
    assert (table["outcome"] == table["stimulus"].map(truth)).all()
    cell = table[(table["readout"] == "full") & (table["scenario"] == "drop")]
    hits = (cell["p_contact"] > 0.5) == cell["outcome"]
    assert cell["test_accuracy"].unique() == pytest.approx([hits.mean()])
    assert (table["fit_trials"] == COUNTS["readout"]).all() and (table["fold"] == -1).all()
    assert (table["recorded_outcome"] == "").all()
    assert (table["fit_labels"] == "simulated").all()
    assert table["validation_loss"].notna().all() and table["copy_last_loss"].gt(0).all()
    # The comparison reads it.
    checked = check_predictions(pd.read_csv(done.paths[0]))
    assert set(checked["readout"]) == set(table["readout"]) and len(checked) == len(table)


@pytest.mark.slow
def test_a_second_run_does_nothing_and_a_damaged_table_is_made_again(
    done: Evaluation, dots: Dataset, work: Path
) -> None:
    steps: list[str] = []

    def note(what: str, done: int, total: int) -> None:
        steps.append(what)

    again = evaluate("frozen-encoder", dots, work, options=OPTIONS, settings=QUICK, progress=note)
    assert steps == [] and again.paths[0] == done.paths[0]
    pd.testing.assert_frame_equal(again.predictions, done.predictions)
    (path,), content = done.paths, done.paths[0].read_bytes()
    path.unlink()
    evaluate("frozen-encoder", dots, work, options=OPTIONS, settings=QUICK, progress=note)
    assert "features" not in steps and "training all" not in steps
    assert path.read_bytes() == content
    # A damaged table is made again.
    for damaged in (b"\n".join(content.split(b"\n")[:3]) + b"\n", b"", b"\xff\xfe" + content,
                    content.replace(b"True", b"Trve", 1)):  # fmt: skip
        path.write_bytes(damaged)
        again = evaluate("frozen-encoder", dots, work, options=OPTIONS, settings=QUICK)
        assert again.paths[0].read_bytes() == content != damaged
        pd.testing.assert_frame_equal(again.predictions, done.predictions)


def test_other_colours_or_scenes_are_another_table(dots: Dataset, tmp_path: Path) -> None:
    paths = evaluate("chance", dots, tmp_path, dry_run=True).paths
    for column, value in (("look", "free"), ("trial_file_sha256", "0" * 64)):
        changed = Dataset(dots.folder)
        changed.index[column] = value
        paths += evaluate("chance", changed, tmp_path, dry_run=True).paths
    assert len(set(paths)) == 3


@pytest.mark.slow
def test_accuracies_are_known_as_soon_as_a_model_has_predicted(dots: Dataset, work: Path) -> None:
    finished: list[EvaluatedModel] = []
    models, settings = ["chance", "blob-centroids"], replace(QUICK, readouts=("observed",))
    both = evaluate(models, dots, work, settings, on_evaluated=finished.append)
    assert [one.path for one in finished] == both.paths
    for one in finished:
        with one.path.open() as stream:
            rows = list(csv.DictReader(stream))
        right: dict[str, list[bool]] = {}
        for row in rows:
            yes = float(row["p_contact"]) > 0.5
            right.setdefault(row["scenario"], []).append(yes == (row["outcome"] == "True"))
        accuracy = fmean(fmean(hits) for hits in right.values())
        assert list(one.accuracies().values()) == [pytest.approx(accuracy)]
        table = read_table(one.path)
        opposite = replace(one, path=work / "opposite.csv")
        write_table(table.assign(recorded_outcome=~table["outcome"]), opposite.path)
        assert list(opposite.accuracies().values()) == [pytest.approx(1 - accuracy)]


@pytest.mark.slow
def test_other_dynamics_share_the_features(done: Evaluation, dots: Dataset, work: Path) -> None:
    steps: list[str] = []
    settings = replace(QUICK, readouts=("observed+simulated",))
    evaluation = evaluate(
        "frozen-encoder", dots, work, options={**TINY, "dynamics": "lstm", "steps": 5},
        settings=settings, progress=lambda what, done, total: steps.append(what),
    )  # fmt: skip
    assert "features" not in steps and steps.count("training all") >= 5
    assert set(evaluation.predictions["model"]) == {"random-test_vit-lstm"}


@pytest.mark.slow
def test_without_a_readout_split_the_tested_trials_are_cross_fitted(
    dots: Dataset, work: Path, done: Evaluation
) -> None:
    tested = Dataset(dots.folder)
    tested.index = tested.index[tested.index["split"] == "testing"].reset_index(drop=True)
    settings = replace(QUICK, folds=4, readouts=("observed", "full"))
    table = evaluate("frozen-encoder", tested, work, options=OPTIONS, settings=settings).predictions
    assert set(table["fold"]) == {0, 1, 2, 3} and len(table) == 2 * 2 * COUNTS["testing"]
    assert (table["fit_trials"] < COUNTS["testing"]).all()
    assert accuracy(table, "full") > 0.7


def test_a_broken_movie_is_one_clear_error_and_leaves_no_table(tmp_path: Path) -> None:
    dots = make_dots(tmp_path / "data", {"readout": 2, "testing": 2}, ("drop",))
    path = dots.paths("drop_testing_0001").observed_movie
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(BadInputError, match="drop_testing_0001"):
        evaluate("frozen-encoder", dots, tmp_path / "out", options=OPTIONS, settings=QUICK)
    assert list((tmp_path / "out").rglob("*.csv")) == []
    assert list((tmp_path / "out").rglob("*.part")) == []


def test_unknown_and_impossible_readouts_are_refused(dots: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="observed"):
        evaluate("chance", dots, tmp_path, settings=EvaluationSettings(readouts=("obs",)))
    with pytest.raises(BadInputError, match="does not support the readout"):
        evaluate(
            "noisy-simulation", dots, tmp_path, settings=EvaluationSettings(readouts=("full",))
        )
    with pytest.raises(UnknownNameError, match="all-but"):
        evaluate("chance", dots, tmp_path, protocols="but-all")
    with pytest.raises(UnknownNameError, match="logistic"):
        evaluate("chance", dots, tmp_path, settings=EvaluationSettings(decision="logistics"))
    assert "frozen-encoder" in models


@pytest.mark.slow
def test_an_encoder_without_dynamics_has_two_readouts(
    dots: Dataset, work: Path, done: Evaluation
) -> None:
    inner: Any = build_model("frozen-encoder", **TINY)

    class Seeing:
        spec = inner.spec
        provenance = inner.provenance
        digest = encoder_digest = inner.encoder_digest

        def encode(self, batch: Any) -> Any:
            return inner.encode(batch.to("cpu")).numpy()

    table = evaluate(Seeing(), dots, work, settings=QUICK).predictions
    assert set(table["readout"]) == {"observed", "full"}
    assert (table["protocol"] == "").all()
    again = done.predictions[done.predictions["readout"] == "full"].reset_index(drop=True)
    same = table[table["readout"] == "full"].reset_index(drop=True)
    assert np.allclose(same["p_contact"], again["p_contact"])


OBSERVED, LATER, FUTURES = (32, 38, 44), (50, 56, 62, 68), 2
"""Frames of a clip of six frames' stride whose context ends at frame 44, by hand."""


def values_of(*key: Any) -> np.ndarray:
    """Return two random numbers that belong to a trial and a frame."""
    return np.random.default_rng([ord(c) for c in repr(key)]).normal(size=2)


class Known:
    """Model with features that are known by trial and frame, and imagined ones by seed and step."""

    spec = Spec(image_size=4, context=3, future=4, context_at="end")
    samples, decision = FUTURES, "logistic"

    def provenance(self) -> Provenance:
        return Provenance("known", "none")

    def digest(self) -> str:
        return "1" * 64

    def encode(self, batch: Any) -> np.ndarray:
        rows = zip(batch.trials, batch.frames.tolist(), strict=True)
        features = [[values_of(trial, frame) for frame in frames] for trial, frames in rows]
        return np.array(features, np.float32)

    def imagine(self, context: Any, samples: int, seed: int) -> Rollout:
        futures = [[[values_of(trial, "future", seed, k, step) for step in range(4)]
                    for k in range(samples)] for trial in context.trials]  # fmt: skip
        return Rollout(features=np.array(futures, np.float32))


@pytest.mark.slow
def test_each_readout_is_scikit_learns_on_the_frames_that_it_may_see(
    dots: Dataset, tmp_path: Path
) -> None:
    settings = EvaluationSettings(logistic=LogisticSettings(grid=(0.5,)))
    table = evaluate(Known(), dots, tmp_path, settings, seed=7).predictions
    index = dots.index.set_index("trial")
    pieces: dict[str, list[tuple[Any, ...]]] = {
        "observed": [(frame,) for frame in OBSERVED],
        "observed+simulated": [
            *((frame,) for frame in OBSERVED),
            *(("future", 7, k, step) for k in range(FUTURES) for step in range(4)),
        ],
        "full": [(frame,) for frame in (*OBSERVED, *LATER)],
    }
    assert set(table["readout"]) == set(pieces)
    for (readout, scenario), rows in table.groupby(["readout", "scenario"]):

        def features(trials: Any, keys: Any = pieces[str(readout)]) -> np.ndarray:
            flat = [np.concatenate([values_of(trial, *key) for key in keys]) for trial in trials]
            return np.array(flat, np.float32).astype(np.float64)

        of_scenario = index[index["scenario"] == scenario]
        fit = of_scenario[of_scenario["split"] == "readout"]
        tested = of_scenario[of_scenario["split"] == "testing"]
        assert list(rows["stimulus"]) == sorted(tested.index)
        oracle = make_pipeline(
            StandardScaler(), LogisticRegression(C=0.5, tol=1e-10, max_iter=100_000)
        ).fit(features(fit.index), fit["contact"])
        expected = oracle.predict_proba(features(rows["stimulus"]))[:, 1]
        assert rows["p_contact"].to_numpy() == pytest.approx(expected, abs=1e-5), readout
        right = oracle.score(features(tested.index), tested["contact"])
        assert rows["test_accuracy"].unique() == pytest.approx([right])
        assert rows["train_accuracy"].unique() == pytest.approx(
            [oracle.score(features(fit.index), fit["contact"])]
        )
        assert set(rows["readout_c"]) == {0.5} and set(rows["fit_trials"]) == {COUNTS["readout"]}


class Remembers(NextBrightness):
    """Network that answers with the fraction of its training trials that belong to Drop."""

    answers, calibration_trials = "observed", 100

    def __init__(self) -> None:
        super().__init__(settings=TrainingSettings(steps=2, batch=2, held_out=0.0))
        self.fraction = torch.nn.Buffer(torch.zeros(()))

    def calibrate(self, whole: Batch) -> None:
        self.fraction.fill_(sum(t.startswith("drop") for t in whole.trials) / len(whole))

    def predict(self, batch: Batch) -> np.ndarray:
        return np.full(len(batch), float(self.fraction))


@pytest.mark.slow
def test_a_scenario_is_predicted_by_the_dynamics_that_its_protocol_trained(
    dots: Dataset, tmp_path: Path
) -> None:
    settings = replace(QUICK, readouts=("observed",), protocols=("all", "all-but", "only"))
    table = evaluate(Remembers(), dots, tmp_path, settings).predictions
    drop = table.groupby(["protocol", "scenario"])["p_contact"].unique().map(list).to_dict()
    assert drop == {
        ("all", "collide"): [0.5], ("all", "drop"): [0.5],
        ("all-but", "collide"): [1.0], ("all-but", "drop"): [0.0],
        ("only", "collide"): [0.0], ("only", "drop"): [1.0],
    }  # fmt: skip


class Fitted:
    """Model that is fitted by itself, and answers with what it was given."""

    spec = Spec(inputs=("rgb",), image_size=4, context=1, future=0, context_at="end")
    answers = "observed"

    def __init__(self, p: float = 0.0) -> None:
        self.p = p

    def provenance(self) -> Provenance:
        return Provenance("fitted", "none")

    def digest(self) -> str:
        return "2" * 64

    def fit(self, batch: Any, labels: np.ndarray, seed: int) -> Fitted:
        assert batch.frames.tolist() == [[44]] * len(labels), "only the observed part"
        truth = [int(trial[-4:]) % 2 == 0 for trial in batch.trials]
        assert all("_readout_" in trial for trial in batch.trials) and list(labels) == truth
        return Fitted(seed / 16)

    def predict(self, batch: Any) -> np.ndarray:
        assert batch.frames.tolist() == [[44]] * len(batch)
        return np.full(len(batch), self.p)


def test_one_half_is_no_contact_and_a_fit_gets_the_seed(dots: Dataset, tmp_path: Path) -> None:
    half = evaluate(Fitted(), dots, tmp_path, seed=8)
    assert set(half.predictions["p_contact"]) == {0.5}
    # Half of the trials have no contact: they are right, the others are wrong.
    assert set(half.scores["accuracy"]) == {0.5}
    contact = half.predictions["outcome"]
    for rows, right in ((half.predictions[~contact], 1.0), (half.predictions[contact], 0.0)):
        assert set(summarise_accuracy(rows)["accuracy"]) == {right}
        part = [
            ScenarioPredictions(
                "drop", "observed", tuple(rows["stimulus"]),
                Decided(np.full(len(rows), 0.5), 1.0), 0, -1, "",
            )
        ]  # fmt: skip
        assert set(make_table(part, Provenance("m", "none"), dots.index)["test_accuracy"]) == {
            right
        }
    above = evaluate(Fitted(), dots, tmp_path, seed=9).predictions
    assert set(above["p_contact"]) == {9 / 16} and set(above["train_accuracy"]) == {0.5}


def rows_of(hits: dict[str, list[bool]], seed: int = 0, **changes: str) -> pd.DataFrame:
    """Return predictions that are right or not as ``hits`` says, by scenario."""
    rows = [
        {"model": "m", "init": "random", "protocol": "all", "readout": "full", "seed": str(seed),
         "benchmark": "v1", "dynamics_training_dataset": "", "scenario": scenario,
         "outcome": True, "recorded_outcome": "", "p_contact": float(hit), **changes}
        for scenario, values in hits.items()
        for hit in values
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_scores_are_means_and_deviations_over_seeds() -> None:
    first = rows_of({"collide": [True, True, False, False], "drop": [True, True]})
    second = rows_of({"collide": [True, True, True, False], "drop": [True, False]}, seed=1)
    summary = summarise_accuracy(pd.concat([first, second]))
    assert list(summary["scenario"]) == ["collide", "drop", MEAN]
    assert list(summary["seeds"]) == [2, 2, 2] and list(summary["trials"]) == [4, 2, 6]
    assert summary["accuracy"].tolist() == pytest.approx([0.625, 0.75, 0.6875])
    expected = [np.std(pair, ddof=1) for pair in ([0.5, 0.75], [1.0, 0.5], [0.75, 0.625])]
    assert summary["spread"].tolist() == pytest.approx(expected)
    other = rows_of({"collide": [True]}, init="imagenet")
    both = summarise_accuracy(pd.concat([first, other]))
    assert set(both["init"]) == {"random", "imagenet"}, "whose rows are not averaged"
    assert both["seeds"].tolist() == [1] * len(both) and both["spread"].isna().all()
    assert len(summarise_accuracy(first.iloc[:0])) == 0


def test_accuracies_are_of_recorded_outcomes_where_they_are_known(
    dots: Dataset, tmp_path: Path
) -> None:
    """A simulation of an official scene may end otherwise than its recording."""
    index = dots.index[dots.index["scenario"] == "drop"].iloc[:3].copy()
    index["contact"], index["recorded_contact"] = True, pd.array([False, None, True], "boolean")
    decided = Decided(np.array([0.9, 0.9, 0.1]), 1.0)
    part = ScenarioPredictions("drop", "observed", tuple(index["trial"]), decided, 0, -1, "")
    table = make_table([part], Provenance("m", "none"), index)
    assert table["test_accuracy"].unique() == pytest.approx([1 / 3])
    write_table(table, tmp_path / "table.csv")
    one = EvaluatedModel("m", "", 0, tmp_path / "table.csv", None, False, {})
    assert list(one.accuracies().values()) == pytest.approx([1 / 3])
    assert Evaluation([one], {}).scores["accuracy"].tolist() == pytest.approx([1 / 3])


@pytest.mark.nightly
@pytest.mark.slow
def test_a_twin_has_random_weights_and_is_the_row_of_the_model_with_random_weights(
    dots: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "weights.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        network = timm.create_model("test_vit", img_size=64, num_classes=0)
    save_file(network.state_dict(), path)
    settings = replace(QUICK, readouts=("observed",))
    trained = {**OPTIONS, "weights": str(path)}
    both = evaluate("frozen-encoder", dots, tmp_path, settings, options=trained, twin=True)
    assert set(both.predictions["model"]) == {"test_vit-mlp", "random-test_vit-mlp"}
    alone = evaluate("frozen-encoder", dots, tmp_path / "alone", settings, options=OPTIONS)
    twin = both.predictions[both.predictions["init"] == "random"]
    assert twin["p_contact"].tolist() == alone.predictions["p_contact"].tolist()
    assert alone.paths[0].name in {one.name for one in both.paths}, "so that nothing is done twice"
    none = evaluate("frozen-encoder", dots, tmp_path, settings, options=OPTIONS, twin=True)
    assert len(none.evaluated) == 1, "a model with random weights is its own twin"


def test_models_have_one_twin_for_each_name_and_none_if_they_are_random_themselves(
    dots: Dataset, tmp_path: Path
) -> None:
    """V-JEPA2 is random unless weights are given; and tables of one name cannot be compared."""
    settings = replace(QUICK, readouts=("observed",), twin=True)

    def planned(*chosen: ChosenModel) -> list[tuple[str, str]]:
        cells = plan_cells(chosen, settings, lambda _: False, twins=True)
        return [(cell.chosen.name, cell.built.provenance().model) for cell in cells]

    random = planned(*choose_models({"V-JEPA2": {"width": 32, "depth": 2, "heads": 2}}))
    assert [name for name, _ in random] == ["V-JEPA2"]
    twins = []
    for seed in (5, 6):
        path = tmp_path / f"{seed}.safetensors"
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = timm.create_model("test_vit", img_size=64, num_classes=0)
        save_file(network.state_dict(), path)
        twins.append({**OPTIONS, "weights": str(path)})
    two = choose_models({"frozen-encoder": twins[0], "timm:test_vit": twins[1]})
    names = [name for name, _ in planned(*two)]
    assert names == ["frozen-encoder", "random twin of frozen-encoder", "timm:test_vit"]
    own = tmp_path / "own.py"
    own.write_text(
        "from support import leaking_models as leaks\n"
        "class Own(leaks.Honest):\n"
        "    def __init__(self, weights: str = 'w.pt'):\n"
        "        assert weights == 'w.pt'\n"
    )
    assert len(planned(*choose_models(f"{own}:Own"))) == 1, "its weights may mean anything"


@pytest.mark.slow
def test_the_twin_of_a_trained_model_is_not_trained(dots: Dataset, tmp_path: Path) -> None:
    """Where training makes the features, random weights must stay random."""
    settings = replace(QUICK, readouts=("observed",))
    table = evaluate("cswm", dots, tmp_path, settings, twin=True).predictions
    assert {init.partition(":")[0] for init in table["init"]} == {"shipped", "random"}
    twin = table[table["init"] == "random"]
    assert (twin["note"] == "untrained").all() and (twin["protocol"] == "").all()
    assert not list((tmp_path / "training").glob("**/*.safetensors"))


@pytest.mark.slow
def test_a_model_and_its_twin_have_readouts_of_one_kind(dots: Dataset, tmp_path: Path) -> None:
    """A readout that ships was fitted on more trials than one that is fitted here."""
    settings = EvaluationSettings(accelerator="cpu", readouts=("observed",))
    coloured = Dataset(dots.folder)
    coloured.index["look"] = "redyellow"
    alone = evaluate("cswm", coloured, tmp_path, settings).predictions
    assert (alone["fit_trials"] > COUNTS["readout"]).all()
    both = evaluate("cswm", coloured, tmp_path, settings, twin=True).predictions
    assert set(both["init"]) > set(alone["init"])
    assert (both["fit_trials"] == COUNTS["readout"]).all() and (both["fit_on"] == "").all()


def test_readouts_that_ship_are_used_where_the_twin_has_them_too() -> None:
    chosen = choose_models(["pEffNetLite0-mlp", "rpin"])
    cells = plan_cells(chosen, EvaluationSettings(), lambda _: False, twins=True)
    assert [cell.chosen.fits for cell in cells] == [False, False, True, True]


# --- readouts that are fitted on another dataset ------------------------------------------------


SCENARIOS = ("collide", "drop")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dots")
    make_dots(folder / "tested", {"testing": 6, "readout": 4}, SCENARIOS)
    make_dots(folder / "fit", {"readout": 12}, SCENARIOS)
    make_dots(folder / "both", {"testing": 6, "readout": 12}, SCENARIOS)
    return folder


@pytest.mark.nightly
@pytest.mark.slow
def test_predictions_are_equal_to_one_dataset_with_both_parts(folder: Path) -> None:
    apart = evaluate("blob-centroids", folder / "tested", folder / "a", fit=folder / "fit")
    whole = evaluate("blob-centroids", folder / "both", folder / "b").predictions
    table = apart.predictions
    pd.testing.assert_frame_equal(table.drop(columns="fit_on"), whole.drop(columns="fit_on"))
    assert (table["fit_trials"] == 12).all() and set(whole["fit_on"]) == {""}
    index = Dataset(folder / "fit").index
    rows = zip(index["scenario"], index["digest"], index["contact"], strict=True)
    digest = digest_of("\n".join(sorted(f"{s} {d} {int(c)}" for s, d, c in rows)))
    assert set(table["fit_on"]) == {f"fit {digest[:12]}"}
    again = evaluate("blob-centroids", folder / "tested", folder / "a", fit=folder / "fit")
    assert again.evaluated[0].done
    assert again.paths != evaluate("blob-centroids", folder / "tested", folder / "a").paths


def changed(folder: Path, name: str, **columns: object) -> Path:
    """Return a copy of the set ``fit`` whose index has other values in the first readout trial."""
    index = Dataset(folder / "fit").index.copy()
    for column, value in columns.items():
        index.loc[0, column] = value
    (folder / name).mkdir()
    write_index(folder / name, index)
    return folder / name


@pytest.mark.slow
def test_trials_that_do_not_fit_the_tested_ones_are_refused(folder: Path) -> None:
    tested = Dataset(folder / "tested").index
    digest = tested["digest"][tested["split"] == "testing"].iloc[0]
    make_dots(folder / "drops", {"readout": 4}, ("drop",))
    (folder / "names").mkdir()
    write_index(folder / "names", tested.assign(split="readout"))
    for fit, words in (
        (changed(folder, "leak", digest=digest), "1 trials of .*leak have motions of tested trial"),
        (changed(folder, "look", look="free"), "the look of tested trials is"),
        (changed(folder, "width", width=128), "the size of the movies of tested trials is"),
        (changed(folder, "rate", playback_seconds=1.0), "the frame rate of tested trials is"),
        (folder / "drops", "has no trial of collide in the split readout"),
        (folder / "names", "both have a trial 'collide_testing_0000'"),
    ):
        with pytest.raises(BadInputError, match=words):
            evaluate("blob-centroids", folder / "tested", folder / "c", fit=fit)
    with pytest.raises(BadInputError, match="fit has no trial in the split 'testing' to predict"):
        evaluate("blob-centroids", folder / "fit", folder / "c", fit=folder / "fit")


@pytest.mark.slow
def test_a_file_of_features_may_have_all_trials_of_both_sets(folder: Path) -> None:
    sets = [Dataset(folder / "tested").index, Dataset(folder / "fit").index]
    chosen = pd.concat(sets).drop_duplicates("trial")
    features = np.random.default_rng(0).normal(size=(len(chosen), 1, 3))
    arrays = {"names": chosen["trial"].to_numpy(str), "frames": [44], "features": features}
    np.savez(folder / "all.npz", **arrays)
    # Readout trials of the tested set, under names that the other set does not have.
    index = sets[0].copy()
    own = index["split"] == "readout"
    index.loc[own, "trial"] = "own_" + index["trial"][own]
    (folder / "named").mkdir()
    write_index(folder / "named", index)
    arrays["names"] = np.append(arrays["names"], index["trial"][own].to_numpy(str))
    arrays["features"] = np.pad(features, ((0, own.sum()), (0, 0), (0, 0)))
    np.savez(folder / "own.npz", **arrays)
    tables = [
        evaluate(str(path), tested, folder / "d", fit=folder / "fit").predictions
        for path, tested in (
            (folder / "all.npz", folder / "tested"),
            (folder / "own.npz", folder / "named"),
        )
    ]
    assert (tables[0]["p_contact"] == tables[1]["p_contact"]).all() and len(tables[0]) == 12


@pytest.mark.slow
def test_labels_of_other_scenarios_are_not_needed(folder: Path) -> None:
    index = Dataset(folder / "fit").index.copy()
    index["contact"] = index["contact"].astype("boolean")
    index.loc[index["scenario"] == "drop", "contact"] = pd.NA
    shutil.copytree(folder / "fit", folder / "unlabelled")
    write_index(folder / "unlabelled", index)
    model, tested, fit = "blob-centroids", folder / "tested", folder / "unlabelled"
    done = evaluate(model, tested, folder / "e", fit=fit, scenario="collide").predictions
    assert set(done["scenario"]) == {"collide"} and done["stimulus"].nunique() == 6
    for scenario in ("", "drop"):
        with pytest.raises(BadInputError, match=r"12 trials .* are stored without labels"):
            evaluate(model, tested, folder / "e", fit=fit, scenario=scenario)
