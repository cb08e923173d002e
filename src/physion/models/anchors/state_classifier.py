"""Anchor `state-classifier`: a statistical shortcut from the state at the last observed frame."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import sklearn
from numpy.typing import NDArray
from sklearn.ensemble import ExtraTreesClassifier

from physion.errors import BadInputError
from physion.models.anchors.observed_motion import motions, observed_motion
from physion.models.anchors.settings_digest import settings_digest
from physion.models.anchors.state_features import NAMES, state_features
from physion.models.batch import Batch, Provenance, Spec
from physion.models.build import make_config
from physion.version import __version__

NAME, VERSION = "state-classifier", 1


@dataclass(frozen=True, slots=True)
class StateClassifierConfig:
    """Settings of `StateClassifier`: number of trees, and smallest number of trials of a leaf."""

    trees: int = 500
    leaf: int = 2

    def __post_init__(self) -> None:
        if min(self.trees, self.leaf) < 1:
            raise BadInputError(f"{NAME}: trees and leaf must be at least 1")


class StateClassifier:
    """Extremely randomised trees on the true state of agent, patient and probe at one instant.

    It sees positions, rotations, velocities and sizes (`state_features`) and knows nothing of
    dynamics, the other bodies and what happened before. A simulator should predict better.

    References
    ----------
    P. Geurts, D. Ernst, L. Wehenkel, Extremely randomized trees, Machine Learning 63, 2006.
    """

    answers = "observed"

    def __init__(self, config: StateClassifierConfig) -> None:
        self.config = config
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0, anchor="end")

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> FittedTrees:
        """Return trees fitted on trials and their outcomes (B,); ``seed`` is that of the trees.

        The order of the trials does not matter. Raises `BadInputError` without trials.
        """
        if len(labels) != len(batch) or len(batch) == 0:
            raise BadInputError(f"{NAME}: {len(labels)} labels for {len(batch)} trials")
        order = np.argsort(np.array(batch.trials), kind="stable")
        trees = ExtraTreesClassifier(
            self.config.trees, min_samples_leaf=self.config.leaf, random_state=seed, n_jobs=1
        )
        trees.fit(_features(batch)[order], np.asarray(labels, np.bool_)[order])
        return FittedTrees(self.config, trees)

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(
            NAME,
            "none",
            encoder_type="true state",
            versions=f"scikit-learn {sklearn.__version__}, physion {__version__}",
        )

    def digest(self) -> str:
        """Return the SHA-256 of code version and settings."""
        return settings_digest(NAME, VERSION, _settings(self.config))


class FittedTrees:
    """`StateClassifier` that was fitted."""

    answers = "observed"

    def __init__(self, config: StateClassifierConfig, trees: ExtraTreesClassifier) -> None:
        self.config = config
        self.trees = trees

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return the mean over trees of the fraction of contacts in a trial's leaf (B,)."""
        if len(batch) == 0:
            return np.zeros(0)
        known = list(self.trees.classes_)
        if True not in known:
            return np.zeros(len(batch))
        fractions = self.trees.predict_proba(_features(batch))[:, known.index(True)]
        return np.asarray(fractions, np.float64)

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and all trees."""
        arrays = [np.asarray(self.trees.classes_)]
        for tree in self.trees.estimators_:
            parts = tree.tree_
            arrays += [parts.children_left, parts.children_right, parts.feature]
            arrays += [parts.threshold, parts.value]
        return settings_digest(NAME, VERSION, _settings(self.config), arrays)


def state_classifier(**options: Any) -> StateClassifier:
    """Build extremely randomised trees on the state at the last observed frame.

    ``options`` are the fields of `StateClassifierConfig`.
    """
    return StateClassifier(make_config(StateClassifierConfig, NAME, options))


def _settings(config: StateClassifierConfig) -> list[Any]:
    """Return what determines the fit, as JSON values."""
    return [dataclasses.asdict(config), NAMES, sklearn.__version__]


def _features(batch: Batch) -> NDArray[np.float64]:
    """Return the features (B, D) of all trials."""
    pairs = zip(motions(batch, NAME), batch.trials, strict=True)
    rows = [state_features(observed_motion(motion, trial)) for motion, trial in pairs]
    return np.array(rows).reshape(len(batch), len(NAMES))
