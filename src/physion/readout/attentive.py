"""Attentive probe: tokens are weighted by learned queries before a logistic regression reads them.

Features of a trial are N tokens x_t of K numbers: one for each time step, or several of them where
a model says so (`Model.tokens`), such as the cells of a grid. For heads h and outcomes y of -1 or 1

    s_ht = q_h . x_t / sqrt(K) + p_ht          score of a token; p_ht belongs to its place
    a_ht = exp(s_ht) / sum_u exp(s_hu)         attention
    f = sum_h w_h . sum_t a_ht x_t + b         log odds of a contact

    C sum log(1 + exp(-y f)) + (|w|^2 + |q|^2 + |p|^2) / 2      is minimised

by L-BFGS; cross-validation chooses C. With one token this is the logistic regression of
`readout.logistic` with C times the number of heads, since equal weights of all heads cost least.

Tokens are standardised by the mean and standard deviation of each feature over all tokens of the
fit trials and, if they are longer, projected on their first `COMPONENTS` principal components. All
is learned from the fit trials, as every readout is. The probes that are published with video
encoders have an attention with D x D projections, and a network after it; a thousand trials do not
determine so many weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from physion.core.errors import BadInputError
from physion.core.seeds import generator
from physion.readout.decisions import Booleans, Decided, Decision
from physion.readout.features import StoredFeatures
from physion.readout.logistic import C_GRID, choose_c, one_answer, stratified_splits

HEADS, COMPONENTS = 4, 64
"""Queries, and numbers of a token."""
GRID = (1e-3, 1e-2, 1e-1, 1.0)
"""Values of C, unless others are set."""
_ITERATIONS = 100
_TRIALS = 32
"""Trials whose features are read at a time."""

Array = NDArray[np.float64]


class AttentiveDecision(Decision):
    """Attentive probe on the tokens of all frames."""

    input: ClassVar[str] = "features"

    def decide(self, fit: Sequence[Any], labels: Booleans, test: Sequence[Any]) -> Decided:
        """Fit on the parts ``fit`` and return the probabilities of the parts ``test``."""
        count = len(test[0])
        if constant := one_answer(labels):
            p, accuracy, note = constant
            return Decided(np.full(count, p), accuracy, note=note)
        settings = self.settings
        if settings.grid == C_GRID:
            settings = replace(settings, grid=GRID)
        mean, basis = _projection(fit, self.tokens)
        known, asked = (_projected(parts, self.tokens, mean, basis) for parts in (fit, test))
        splits, note = stratified_splits(labels, settings)
        outcomes = torch.from_numpy(labels.astype(np.float64))
        scores = []
        for fitted, held in splits:
            path = _fit(known[fitted], outcomes[fitted], settings.grid)
            scores.append(np.column_stack([_odds(known[held], probe) for probe in path]))
        c, cv_accuracy = choose_c(scores, splits, labels, settings)
        probe = _fit(known, outcomes, tuple(value for value in settings.grid if value <= c))[-1]
        accuracy = float(np.mean((_odds(known, probe) > 0) == labels))
        odds = np.clip(_odds(asked, probe), -700, 700)
        return Decided(1 / (1 + np.exp(-odds)), accuracy, c, cv_accuracy, note=note)


def _read(parts: Sequence[Any], tokens: int) -> Iterator[Array]:
    """Yield the tokens (trials, N, D) of some trials at a time."""
    for start in range(0, len(parts[0]), _TRIALS):
        rows = np.arange(start, min(start + _TRIALS, len(parts[0])))
        pieces = []
        for part in parts:
            of = part.select(rows).array() if isinstance(part, StoredFeatures) else part[rows]
            if of.shape[2] % tokens:
                raise BadInputError(
                    f"features of {of.shape[2]} numbers cannot be divided into {tokens} tokens; "
                    "use the decision logistic"
                )
            pieces.append(of.reshape(len(rows), of.shape[1] * tokens, -1))
        if len({piece.shape[2] for piece in pieces}) > 1:
            raise BadInputError(
                "observed and imagined features differ in size, so they cannot be tokens of one "
                "kind; use the decision logistic"
            )
        yield np.concatenate(pieces, axis=1).astype(np.float64)


def _projection(parts: Sequence[Any], tokens: int) -> tuple[Array, Array]:
    """Return mean (D,) and basis (D, K) by which tokens x become (x - mean) basis."""
    total, count = np.float64(0), 0
    for block in _read(parts, tokens):
        total, count = total + block.sum((0, 1)), count + block.shape[0] * block.shape[1]
    mean: Array = np.asarray(total / count)
    products: Any = 0.0
    for block in _read(parts, tokens):
        apart = (block - mean).reshape(-1, len(mean))
        products = products + apart.T @ apart
    deviation = np.sqrt(np.diag(products) / count)
    varies = deviation > 1e-9 * np.maximum(np.abs(mean), 1e-30)
    scale = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=varies)
    if len(mean) <= COMPONENTS:
        return mean, np.diag(scale)
    _, vectors = np.linalg.eigh(products / count * scale * scale[:, None])
    return mean, scale[:, None] * vectors[:, -COMPONENTS:]


def _projected(parts: Sequence[Any], tokens: int, mean: Array, basis: Array) -> Tensor:
    """Return the tokens (n, N, K) of trials, standardised and projected."""
    found = [(block - mean) @ basis for block in _read(parts, tokens)]
    if not found:
        return torch.zeros(0, 1, basis.shape[1], dtype=torch.float64)
    return torch.from_numpy(np.concatenate(found))


Probe = tuple[Tensor, Tensor, Tensor, Tensor]
"""Queries (H, K), scores of places (H, N), weights (H, K), and intercept."""


def _log_odds(tokens: Tensor, probe: Probe) -> Tensor:
    queries, places, weights, intercept = probe
    scores = tokens @ queries.T / math.sqrt(queries.shape[1]) + places.T
    attention = scores.softmax(dim=1)
    read = torch.einsum("nth,ntk->nhk", attention, tokens)
    return torch.einsum("nhk,hk->n", read, weights) + intercept


def _odds(tokens: Tensor, probe: Probe) -> Array:
    """Return the log odds (n,) of a contact."""
    with torch.no_grad():
        odds: Array = _log_odds(tokens, probe).numpy()
        return odds


def _fit(tokens: Tensor, outcomes: Tensor, grid: Sequence[float]) -> list[Probe]:
    """Return the probe for each C of ``grid``, ascending; each starts from the one before."""
    places, size = tokens.shape[1:]
    start = generator("attentive probe").normal(0.0, 0.5, (HEADS, size))
    rate = float(outcomes.mean())
    probe: Probe = (
        torch.from_numpy(start),
        torch.zeros(HEADS, places, dtype=torch.float64),
        torch.zeros(HEADS, size, dtype=torch.float64),
        torch.tensor(math.log(rate / (1 - rate)), dtype=torch.float64),
    )
    found = []
    with torch.enable_grad():
        for c in grid:
            probe = _minimise(tokens, outcomes, c, probe)
            found.append(probe)
    return found


def _minimise(tokens: Tensor, outcomes: Tensor, c: float, start: Probe) -> Probe:
    """Return the probe at a minimum of the objective for one C."""
    queries, places, weights, intercept = (part.clone().requires_grad_(True) for part in start)
    probe: Probe = (queries, places, weights, intercept)
    optimizer = torch.optim.LBFGS(
        probe, max_iter=_ITERATIONS, tolerance_grad=1e-6, line_search_fn="strong_wolfe"
    )

    def objective() -> Tensor:
        optimizer.zero_grad()
        odds = _log_odds(tokens, probe)
        loss = c * functional.binary_cross_entropy_with_logits(odds, outcomes, reduction="sum")
        loss = loss + sum((part**2).sum() for part in (queries, places, weights)) / 2
        loss.backward()  # type: ignore[no-untyped-call]
        return loss

    optimizer.step(objective)  # type: ignore[no-untyped-call]
    return queries.detach(), places.detach(), weights.detach(), intercept.detach()
