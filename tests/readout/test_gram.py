"""Gram matrices of features in files and in memory, and the memory that they take."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.core.errors import BadInputError
from physion.readout.features import ArraysInMemory, StoredFeatures, open_features, write_features
from physion.readout.logistic import Fit, JoinedFeatures, LogisticSettings, fit_readout, gram, grams


def features_of(n: int, steps: int, size: int, seed: int = 0) -> np.ndarray:
    """Return float32 features with offsets and scales that differ by column."""
    rng = np.random.default_rng(seed)
    shape = (n, steps, size)
    values = rng.normal(size=shape) * rng.uniform(0.1, 10, shape[1:]) + rng.normal(size=shape[1:])
    return values.astype(np.float32)


def stored(folder: Path, values: np.ndarray) -> StoredFeatures:
    """Return features that are written to files."""
    rows = []
    for number, row in enumerate(values):
        path = folder / f"{values.shape[1]}-{number}.safetensors"
        write_features(path, {"features": row})
        rows.append(open_features(path))
        assert rows[-1] is not None
    return StoredFeatures([f"trial {number}" for number in range(len(values))], rows)  # type: ignore[arg-type]


def expected_gram(flat: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Return the Gram matrix of all columns at once."""
    exact = flat.astype(np.float64)
    scaled = (exact - exact[fitted].mean(0)) / exact[fitted].std(0)
    product: np.ndarray = scaled @ scaled[fitted].T
    return product


def test_stored_features_are_read_in_any_piece(tmp_path: Path) -> None:
    values = features_of(6, 4, 10)
    features = stored(tmp_path, values)
    assert features.shape == (6, 4, 10) and len(features) == 6
    assert (features.array() == values).all() and features.array().dtype == np.float32
    assert all((features.frame(step) == values[:, step]).all() for step in range(4))
    assert (features.columns(7, 23) == values.reshape(6, -1)[:, 7:23]).all()
    assert features.columns(35, 99).shape == (6, 5)
    chosen = features.select([4, 0, 4])
    assert (chosen.array() == values[[4, 0, 4]]).all()
    assert chosen.trials == ("trial 4", "trial 0", "trial 4")
    assert features.select([]).shape == (0, 4, 10)


@pytest.mark.parametrize("block", [1, 7, 1024])
def test_a_gram_matrix_matches_standardised_features(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr("physion.readout.logistic._COLUMNS", block)
    monkeypatch.setattr("physion.readout.logistic._READ_BYTES", 1000)
    first, second = features_of(12, 3, 9), features_of(12, 2, 9, seed=1)
    flat = np.concatenate([first, second], axis=1).reshape(12, -1)
    fitted = np.array([7, 0, 3, 4, 9, 11, 2])
    expected = expected_gram(flat, fitted)
    parts: list[Any] = [stored(tmp_path, first), stored(tmp_path, second)]
    for inputs in (flat, [first, second], parts, [first, parts[1]]):
        assert gram(inputs, fitted) == pytest.approx(expected, rel=1e-10, abs=1e-9)


def test_fits_are_standardised_apart_and_rows_count_through_tables(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values = features_of(15, 2, 30).reshape(15, -1)
    tables = [JoinedFeatures(values[:10]), JoinedFeatures(values[10:], "test")]
    fits = [
        Fit(np.arange(0, 10, 2), np.arange(1, 10, 2)),
        Fit(np.arange(1, 10, 2), np.arange(0, 10, 2)),
        Fit(np.arange(10), np.arange(10, 15)),
    ]
    together = grams(tables, fits)
    for fit, (within, across) in zip(fits, together, strict=True):
        expected = expected_gram(values, fit.fitted)
        assert within == pytest.approx(expected[fit.fitted], rel=1e-10, abs=1e-9)
        assert across == pytest.approx(expected[fit.others], rel=1e-10, abs=1e-9)
    # With little memory the features are read once for every fit.
    monkeypatch.setattr("physion.readout.logistic._GRAM_BYTES", 1)
    for one, other in zip(together, grams(tables, fits), strict=True):
        assert (one[0] == other[0]).all() and (one[1] == other[1]).all()


@pytest.mark.parametrize("released", [False, True])
def test_a_readout_of_files_matches_arrays(tmp_path: Path, released: bool) -> None:
    context, imagined = features_of(50, 3, 40), features_of(50, 2, 40, seed=1)
    labels = context[:, 0, 0] + imagined[:, 1, 3] > np.median(context[:, 0, 0])
    flat = np.concatenate([context, imagined], axis=1).reshape(50, -1)
    config = LogisticSettings(grid=(1e-4, 1e-2, 1.0), balance=True, released=released)
    arrays = fit_readout(flat[:40], labels[:40], flat[40:], config)
    parts = [stored(tmp_path, context), stored(tmp_path, imagined)]
    train, test = ([part.select(rows) for part in parts] for rows in (range(40), range(40, 50)))
    files = fit_readout(train, labels[:40], test, config)
    assert (files.probability == arrays.probability).all()
    assert (files.c, files.cv_accuracy) == (arrays.c, arrays.cv_accuracy)
    nothing = fit_readout(train, labels[:40], [part.select([]) for part in parts], config)
    assert nothing.probability.shape == (0,) and nothing.train_accuracy == arrays.train_accuracy


def test_wrong_features_are_refused() -> None:
    values = features_of(6, 2, 3)
    with pytest.raises(BadInputError, match=r"\(6, 2, 3\), \(5, 2, 3\)"):
        JoinedFeatures([values, values[:5]])
    with pytest.raises(BadInputError, match="not none"):
        JoinedFeatures([])
    with pytest.raises(BadInputError, match=r"not \(6,\)"):
        JoinedFeatures(values[:, 0, 0])
    values[4, 1, 1] = np.inf
    rows = [ArraysInMemory({"features": row}) for row in values]
    bad = StoredFeatures([str(number) for number in range(6)], rows)
    with pytest.raises(BadInputError, match="training trial 4 has a feature that is not finite"):
        gram(bad, np.arange(6))
    labels = np.array([True, False] * 3)
    with pytest.raises(BadInputError, match="test trial 1 has a feature that is not finite"):
        fit_readout(values[:4], labels[:4], bad.select([0, 4]))


PEAK = """
import json, resource, sys
from pathlib import Path
import numpy as np
from physion.readout.features import open_features, write_features
from physion.readout.logistic import fit_readout
from physion.readout.features import StoredFeatures

folder, trials, steps, size = Path(sys.argv[1]), 300, 25, 8000
rng = np.random.default_rng(0)
rows = []
for number in range(trials):
    path = folder / str(number)
    features = rng.standard_normal((steps, size), np.float32) + number % 2 / 10
    write_features(path, {"features": features})
    rows.append(open_features(path))
features = StoredFeatures([str(number) for number in range(trials)], rows)
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before = peak()
fitted = fit_readout(
    features.select(range(200)), np.arange(200) % 2 == 0, features.select(range(200, 300))
)
print(json.dumps({
    "ratio": (peak() - before) / (trials * steps * size * 4),
    "probability": fitted.probability.tolist(),
}))
"""


@pytest.mark.slow
def test_a_readout_needs_less_memory_than_its_features(tmp_path: Path) -> None:
    """The features take 240 MB, their standardised float64 copy would take twice as much."""
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(tmp_path)], capture_output=True, text=True, check=True
    )
    result = json.loads(done.stdout)
    assert result["ratio"] < 0.6
    answers = np.array(result["probability"]) > 0.5
    assert (answers == (np.arange(200, 300) % 2 == 0)).all(), "and it is the right readout"
