"""Extremely randomised trees on features: the decision *trees*, and forests that can be stored.

A logistic regression sees every feature by itself. Trees also see that two of them matter together,
such as a velocity and a distance.

References
----------
P. Geurts, D. Ernst, L. Wehenkel, Extremely randomized trees, Machine Learning 63, 2006.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from physion.readout.decisions import Booleans, Decided, Decision
from physion.readout.logistic import (
    JoinedFeatures,
    LogisticSettings,
    one_answer,
    stratified_splits,
)

TREES, LEAF, FRACTION = 64, 4, 0.2
"""Trees, smallest number of fit trials of a leaf, and fraction of features tried for a split.

Forests of all scenarios for 1000 trials take 1.4 MB with these; more trees are hardly better."""
_LEAF = -1
"""In place of a feature, for a leaf."""


@dataclass(frozen=True, eq=False)
class Forest:
    """Fitted trees, one after the other, each with every node before its left and right subtree.

    - ``feature`` (nodes,) int32: feature that a node compares, or -1 for a leaf.
    - ``value`` (nodes,) float16: largest value of the feature that goes left, or, of a leaf, the
      fraction of contacts among its fit trials.
    - ``train_accuracy``, ``cv_accuracy``: on the fit trials, and over folds.
    """

    feature: NDArray[np.int32]
    value: NDArray[np.float16]
    train_accuracy: float = math.nan
    cv_accuracy: float = math.nan

    def probability(self, features: NDArray[Any]) -> NDArray[np.float64]:
        """Return P(contact) (m,), the mean of the trees, from features (m, d)."""
        rounded = _rounded(features)
        roots, right = self._structure
        total, rows = np.zeros(len(rounded)), np.arange(len(rounded))
        for root in roots:
            node = np.full(len(rounded), root)
            while (inner := self.feature[node] != _LEAF).any():
                at, row = node[inner], rows[inner]
                left = rounded[row, self.feature[at]] <= self.value[at]
                node[inner] = np.where(left, at + 1, right[at])
            total += self.value[node]
        return total / len(roots)

    @cached_property
    def _structure(self) -> tuple[list[int], NDArray[np.int64]]:
        """Return the first node of every tree, and the right child of every node."""
        right = np.zeros(len(self.feature), np.int64)
        roots: list[int] = []
        waiting: list[int] = []
        for node, feature in enumerate(self.feature.tolist()):
            if node == 0 or self.feature[node - 1] == _LEAF:
                if waiting:
                    right[waiting.pop()] = node
                else:
                    roots.append(node)
            if feature != _LEAF:
                waiting.append(node)
        return roots, right


def fit_forest(features: NDArray[Any], labels: Booleans, *, trees: int = TREES) -> Forest:
    """Return trees fitted on features (n, d) and outcomes (n,).

    Features and thresholds are rounded to float16, so that stored trees answer as fitted ones.
    """
    # Here, since importing scikit-learn takes longer than finding a finished evaluation.
    from sklearn.ensemble import ExtraTreesClassifier

    forest = ExtraTreesClassifier(
        trees, min_samples_leaf=LEAF, max_features=FRACTION, random_state=0, n_jobs=1
    )
    forest.fit(_rounded(features), labels)
    chosen, values = [], []
    for estimator in forest.estimators_:
        tree = estimator.tree_
        inner = tree.children_left >= 0
        contact = tree.value[:, 0, list(forest.classes_).index(True)] / tree.value[:, 0].sum(axis=1)
        chosen.append(np.where(inner, tree.feature, _LEAF))
        values.append(np.where(inner, _below(tree.threshold), contact))
    fitted = Forest(
        np.concatenate(chosen).astype(np.int32), np.concatenate(values).astype(np.float16)
    )
    accuracy = float(np.mean((fitted.probability(features) > 0.5) == labels))
    return Forest(fitted.feature, fitted.value, accuracy)


def cross_validate(features: NDArray[Any], labels: Booleans, settings: LogisticSettings) -> float:
    """Return the mean accuracy of trees over the folds of a readout; NaN for too few trials."""
    splits, _ = stratified_splits(labels, settings)
    hits = [
        np.mean((fit_forest(features[f], labels[f]).probability(features[h]) > 0.5) == labels[h])
        for f, h in splits
    ]
    return float(np.mean(hits)) if hits else math.nan


class TreesDecision(Decision):
    """Extremely randomised trees on the features of all frames; folds are only for the accuracy."""

    input: ClassVar[str] = "features"

    def decide(self, fit: Sequence[Any], labels: Booleans, test: Sequence[Any]) -> Decided:
        """Fit on the parts ``fit`` and return the probabilities of the parts ``test``."""
        tested = JoinedFeatures(test, "test").array()
        if constant := one_answer(labels):
            p, train_accuracy, note = constant
            return Decided(np.full(len(tested), p), train_accuracy, note=note)
        features = JoinedFeatures(fit).array()
        forest = fit_forest(features, labels)
        accuracy = cross_validate(features, labels, self.settings)
        return Decided(forest.probability(tested), forest.train_accuracy, cv_accuracy=accuracy)


def _below(thresholds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest float16 that are not above thresholds; they split float16 alike."""
    near = thresholds.astype(np.float16)
    return np.where(near > thresholds, np.nextafter(near, np.float16(-np.inf)), near)


def _rounded(features: NDArray[Any]) -> NDArray[np.float32]:
    """Return features rounded to float16, as float32."""
    return features.astype(np.float16).astype(np.float32)
