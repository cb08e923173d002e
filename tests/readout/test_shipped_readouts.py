"""Readouts as weights and trees, in files, and readouts that ship with the package."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler

from physion.core.errors import BadInputError
from physion.core.names import SCENARIOS
from physion.models.build import build_model
from physion.readout.decisions import Readout
from physion.readout.evaluate import evaluate
from physion.readout.features import StoredFeatures, write_features
from physion.readout.folds import unlike_shipped
from physion.readout.logistic import LogisticSettings, fit_readout, fit_weights
from physion.readout.shipped import (
    ShippedReadout,
    ShippedReadouts,
    find_readouts,
    shipped_files,
    write_readouts,
)
from physion.readout.trees import FRACTION, LEAF, Forest, fit_forest
from physion.trials.dataset import Dataset
from physion.trials.files import MOVIE_ALONE
from physion.trials.index import write_index
from support.moving_dots import make_dots

MODELS = {
    "state-trees": ("state-trees", {}),
    "mask-trees": ("mask-trees", {}),
    "blob-trees": ("blob-trees", {}),
    "blob-centroids": ("blob-centroids", {}),
    "tf_efficientnet_lite0": ("pEffNetLite0-lstm", {}),
    "random-tf_efficientnet_lite0": ("pEffNetLite0-mlp", {"weights": "random"}),
    "cswm-small": ("cswm", {}),
    "rpin-small": ("rpin", {}),
    "svg-small": ("svg", {}),
    "op3-small": ("op3", {}),
}
"""Models that files belong to, by name."""
ALL = ("observed", "observed+simulated", "full")
KINDS = {
    "state-trees": ALL[:1], "rpin-small": ALL, "cswm-small": ALL, "svg-small": ALL,
    "op3-small": ALL,
}  # fmt: skip
"""Readouts of models, where they are not observed and full."""


def problem(n: int, steps: int, size: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return features (n, steps, size) of many scales and offsets, and noisy labels."""
    rng = np.random.default_rng(seed)
    plain = rng.normal(size=(n, steps, size))
    labels = plain[:, 0, 0] + plain[:, -1, 1] + 0.5 * rng.normal(size=n) > 0
    scaled = plain * rng.uniform(0.1, 10, size) + rng.normal(size=size) * 5
    return scaled.astype(np.float32), labels


@pytest.mark.parametrize("size", [4, 300])
def test_weights_give_the_probabilities_of_the_readout_and_of_scikit_learn(size: int) -> None:
    everything, answers = problem(160, 3, size, 0)
    features, labels, tested = everything[:120], answers[:120], everything[120:]
    settings = LogisticSettings(grid=(1e-3, 1e-2))
    linear = fit_weights([features], labels, settings)
    expected = fit_readout([features], labels, [tested], settings)
    flat = tested.reshape(40, -1)
    assert linear.probability(flat) == pytest.approx(expected.probability, abs=1e-7)
    assert (linear.c, linear.cv_accuracy) == (expected.c, expected.cv_accuracy)
    assert linear.train_accuracy == expected.train_accuracy
    scaler = StandardScaler().fit(features.reshape(120, -1))
    oracle = LogisticRegression(C=linear.c, tol=1e-10, max_iter=10_000)
    oracle.fit(scaler.transform(features.reshape(120, -1)), labels)
    assert linear.probability(flat) == pytest.approx(
        oracle.predict_proba(scaler.transform(flat))[:, 1], abs=1e-4
    )


def test_one_outcome_gives_no_weights() -> None:
    with pytest.raises(BadInputError, match="3 trials without both outcomes"):
        fit_weights(np.zeros((3, 2)), np.ones(3, bool))


def test_stored_trees_answer_as_scikit_learn() -> None:
    everything, answers = problem(210, 2, 5, 2)
    features, labels, tested = everything[:150], answers[:150], everything[150:]
    forest = fit_forest(features.reshape(150, -1), labels, trees=20)

    def rounded(values: np.ndarray) -> np.ndarray:
        return values.reshape(len(values), -1).astype(np.float16).astype(np.float32)

    oracle = ExtraTreesClassifier(20, min_samples_leaf=LEAF, max_features=FRACTION, random_state=0)
    oracle.fit(rounded(features), labels)
    expected = oracle.predict_proba(rounded(tested))[:, 1]
    # Fractions of leaves are rounded to float16.
    assert forest.probability(tested.reshape(60, -1)) == pytest.approx(expected, abs=5e-4)
    assert forest.train_accuracy == np.mean(oracle.predict(rounded(features)) == labels)


def test_trees_know_late_features_from_early_ones(tmp_path: Path) -> None:
    labels = np.arange(40) % 2 == 0
    features = np.zeros((40, 40_000), np.float32)
    features[:, 35_000:] = labels[:, None]
    forest = fit_forest(features, labels, trees=3)
    assert forest.feature.max() >= 35_000 and forest.train_accuracy == 1
    made = {(Readout.FULL, "drop"): ShippedReadout(forest, 1, 40_000, 40, "")}
    with pytest.raises(BadInputError, match="features up to 32767"):
        write_readouts(tmp_path / "own.safetensors", "0" * 64, "own 123", made)
    assert not list(tmp_path.iterdir())


def stored(folder: Path, values: np.ndarray) -> StoredFeatures:
    """Return features (n, steps, size) in files."""
    files = [
        write_features(folder / f"{row}.safetensors", {"features": one})
        for row, one in enumerate(values)
    ]
    return StoredFeatures([str(row) for row in range(len(values))], files, repeated=True)


def test_a_file_gives_the_readouts_again(tmp_path: Path) -> None:
    everything, answers = problem(170, 4, 30, 4)
    features, labels, tested = everything[:120], answers[:120], everything[120:]
    linear = fit_weights([features], labels, LogisticSettings(grid=(1e-2,)))
    # A strong penalty in another scenario, so that weights of two magnitudes share a file.
    other = fit_weights([features], labels, LogisticSettings(grid=(1e-6,)))
    forest = fit_forest(features.reshape(120, -1), labels, trees=5)
    made: dict[tuple[Readout, str], ShippedReadout] = {
        (Readout.OBSERVED, "drop"): ShippedReadout(linear, 4, 30, 120, ""),
        (Readout.OBSERVED, "roll"): ShippedReadout(other, 4, 30, 120, ""),
        (Readout.FULL, "drop"): ShippedReadout(forest, 4, 30, 120, ""),
    }
    path = tmp_path / "own.safetensors"
    write_readouts(path, "0" * 64, "own 123", made)
    read = ShippedReadouts(path)
    parts = [stored(tmp_path, tested)]
    for (readout, scenario), one in made.items():
        known = read.find(readout, scenario)
        assert known is not None and (known.fit_trials, known.fit_on) == (120, "own 123")
        decided = known.decide(parts)
        expected = one.fitted.probability(tested.reshape(50, -1))
        assert np.corrcoef(decided.probability, expected)[0, 1] > 0.999
        close = 0 if isinstance(one.fitted, Forest) else 0.02
        assert decided.probability == pytest.approx(expected, abs=close + 1e-9)
        assert decided.cv_accuracy == pytest.approx(one.fitted.cv_accuracy, nan_ok=True)
    assert read.find(Readout.FULL, "roll") is None
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(BadInputError, match="install the package again"):
        ShippedReadouts(path)


def test_clips_are_cut_or_repeated_to_the_steps_of_the_fit(tmp_path: Path) -> None:
    everything, answers = problem(90, 5, 6, 6)
    linear = fit_weights([everything[:80, :3]], answers[:80])
    known, tested = ShippedReadout(linear, 3, 6, 80, ""), everything[80:]
    cut = known.decide([stored(tmp_path / "long", tested)]).probability
    assert cut == pytest.approx(known.fitted.probability(tested[:, :3].reshape(10, -1)))
    short = known.decide([stored(tmp_path / "short", tested[:, :2])]).probability
    repeated = tested[:, [0, 1, 1]].reshape(10, -1)
    assert short == pytest.approx(known.fitted.probability(repeated))


# Readouts of the package.


def test_files_are_small_and_belong_to_models() -> None:
    files = {path.stem: path for path in shipped_files()}
    assert set(files) <= set(MODELS)
    sizes = {name: path.stat().st_size for name, path in files.items()}
    # Those of true states and masks come on top of what sees pictures.
    true = sizes.pop("state-trees") + sizes.pop("mask-trees")
    assert sum(sizes.values()) < 4_000_000 and true < 1_500_000
    for name, path in files.items():
        model_name, options = MODELS[name]
        model = build_model(model_name, **options)
        if name.startswith("random"):
            # Random weights are another's with another version of torch.
            continue
        found = find_readouts(model)
        assert found is not None and found.sha256 == ShippedReadouts(path).sha256
        assert found.kinds == KINDS.get(name, ("observed", "full"))
        card = path.with_suffix(".md").read_text()
        assert model.readout_digest() in card
        for scenario in SCENARIOS:
            known = found.find(Readout.OBSERVED, scenario)
            assert known is not None and known.fit_on in card


def test_other_settings_have_no_readouts() -> None:
    assert find_readouts(build_model("blob-centroids", image_size=32)) is None
    assert find_readouts(build_model("noisy-simulation")) is None


@pytest.mark.slow
@pytest.mark.parametrize(("fit_trials", "fit_on"), [(8, ""), (9, "set 0123")])
def test_own_trials_are_fitted_where_there_are_as_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fit_trials: int, fit_on: str
) -> None:
    make_dots(tmp_path / "dots", {"testing": 2, "readout": 8}, ("drop",))
    index = Dataset(tmp_path / "dots").index
    index["look"] = "redyellow"
    write_index(tmp_path / "dots", index)
    features, labels = problem(20, 8, 6, 7)
    known = ShippedReadout(fit_weights([features], labels), 8, 6, fit_trials, "")
    path = tmp_path / "own.safetensors"
    write_readouts(path, "0" * 64, "set 0123", {(Readout.OBSERVED, "drop"): known})
    known_to = "physion.readout.evaluation.find_readouts"
    monkeypatch.setattr(known_to, lambda _: ShippedReadouts(path))
    done = evaluate("blob-centroids", tmp_path / "dots", tmp_path / "out", readouts=("observed",))
    assert set(done.predictions["fit_on"]) == {fit_on}
    assert set(done.predictions["fit_trials"]) == {fit_trials}
    # Movies have 64 pixels per side, as the model's pictures by default.
    for look, size, words in (
        ("redyellow", 64, ""),
        ("redyellow", 128, "stored movies of 64 x 64 pixels, and the model sees 128 ("),
        ("free", 64, "are not used, since the look of the tested ones is free"),
    ):
        write_index(tmp_path / "dots", index.assign(look=look))
        for _ in ("made", "done before"):
            done = evaluate(
                "blob-centroids", tmp_path / "dots", tmp_path / "out", readouts=("observed",),
                options={"image_size": size},
            )  # fmt: skip
            assert len(done.warnings) == bool(words and fit_on)
            assert all(words in one for one in done.warnings)
    other = index.assign(playback_seconds=1.51)
    spec = build_model("blob-centroids").spec
    assert unlike_shipped(other, spec, rendered=True) == ["a frame rate of 100.0/s, not 30/s"]
    assert not unlike_shipped(other, build_model("state-trees").spec, rendered=False)
    assert not unlike_shipped(index, replace(spec, image_size=128), rendered=True)


def test_looks_and_movies_that_a_pretrained_model_never_saw_are_refused_or_named(
    tmp_path: Path,
) -> None:
    make_dots(tmp_path / "dots", {"testing": 2}, ("drop",))
    index = Dataset(tmp_path / "dots").index
    pixels = partial(evaluate, "intuition-pixels", tmp_path / "dots", tmp_path / "out")
    write_index(tmp_path / "dots", index.assign(look="free"))
    with pytest.raises(BadInputError, match=r"the look redyellow, .* look free; .* cue=true"):
        pixels()
    assert pixels(options={"cue": True}, dry_run=True).evaluated
    write_index(tmp_path / "dots", index.assign(look="redyellow"))
    (words,) = pixels().warnings
    assert "stored movies of 64 x 64 pixels, and the model sees 96 (" in words
    write_index(tmp_path / "dots", index.assign(look="free", engine=MOVIE_ALONE))
    assert "movies were imported, and may not have" in pixels().warnings[-1]
    oblong, _ = unlike_shipped(
        index.assign(width=128), build_model("intuition-pixels").spec, rendered=False
    )
    assert oblong == "movies of 128 x 64 pixels, which are squeezed to squares"
