"""Levels of crossed groupings, sorted so that their equations split into small dense blocks.

Z is the matrix of indicators of levels, W the diagonal of weights of rows. Within one grouping Z'WZ
is diagonal. So the grouping with most levels ("wide") is eliminated first, and what remains is a
dense matrix over the levels of the others ("narrow"), which splits if no row links its levels: with
participants and stimuli within scenarios, into one of 100 x 100 per scenario. Genuinely crossed
designs give one larger block and the same result. `factor` solves the equations.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]
Codes = npt.NDArray[np.int64]

MOST_CELLS = 100_000_000
"""Cells of the dense cross tables above which a design is refused (0.8 GB each)."""

FULL_BLOCK = 64
"""Narrow levels up to which unlinked parts share a block: many tiny ones would be slow."""


@dataclass(frozen=True)
class Counts:
    """Z'WZ: sums of weights by wide level, by wide x narrow level, by narrow x narrow level.

    The last two are lists over blocks, of shapes (d, e) and (e, e).
    """

    wide: Array
    cross: list[Array]
    narrow: list[Array]


class Groupings:
    """Positions of rows in the equations: levels sorted into blocks, and cells of the cross tables.

    ``codes``: one array (n,) a grouping with values 0..levels-1, all present. Positions in the
    vectors of random effects ("slots", q in all) are by block, wide levels first;
    ``slots[k][code]`` maps a level to its slot and ``rows[k]`` each row. Random slopes are
    groupings of the same codes whose entries of Z are not 1: see `with_values`.
    """

    def __init__(self, codes: Sequence[Codes]) -> None:
        self.n = len(codes[0])
        self.levels = [int(code.max()) + 1 for code in codes]
        self.q = sum(self.levels)
        self.wide = int(np.argmax(self.levels))
        self._narrow = [k for k in range(len(codes)) if k != self.wide]
        self.q_wide = self.levels[self.wide]
        self.slots = self._sort_into_blocks(codes)
        self.rows = [slot[code] for slot, code in zip(self.slots, codes, strict=True)]
        self.owner = np.empty(self.q, dtype=np.int64)
        for k, slot in enumerate(self.slots):
            self.owner[slot] = k
        self._values: Sequence[Array] | None = None
        self._index_cells()

    def with_values(self, values: Sequence[Array]) -> Groupings:
        """Return the same groupings with ``values[k]`` (n,) as the entries of Z in place of 1."""
        result = copy.copy(self)
        result._values = values
        return result

    def entries(self, k: int, scale: Array) -> Array:
        """Return the entries (n,) of Z Lambda for grouping ``k``; ``scale`` by slot (q,)."""
        entries = scale[self.rows[k]]
        return entries if self._values is None else entries * self._values[k]

    def _weighted(self, weights: Array | None, *of: int) -> Array | None:
        """Return ``weights`` times the entries of Z of the groupings ``of``."""
        if self._values is None:
            return weights
        product = weights
        for k in of:
            product = self._values[k] if product is None else product * self._values[k]
        return product

    def _sort_into_blocks(self, codes: Sequence[Codes]) -> list[Codes]:
        """Return the slots of each grouping's levels; set the bounds of the blocks."""
        start = np.cumsum([0, *self.levels])
        links = [(start[self.wide] + codes[self.wide], start[k] + codes[k]) for k in self._narrow]
        label = np.zeros(self.q, dtype=np.int64)
        if links:
            one, other = (np.concatenate(part) for part in zip(*links, strict=True))
            graph = coo_array((np.ones(len(one)), (one, other)), (self.q, self.q))
            label = connected_components(graph.tocsr(), directed=False)[1].astype(np.int64)
        parts = [label[start[k] : start[k + 1]] for k in range(len(codes))]
        narrow = np.concatenate([parts[k] for k in self._narrow]) if links else np.zeros(0, int)
        # Parts share a block until it holds FULL_BLOCK narrow levels.
        before = np.cumsum(np.bincount(narrow, minlength=label.max() + 1)) - 1
        block = np.unique(np.maximum(before, 0) // FULL_BLOCK, return_inverse=True)[1]
        wide_block, narrow_block = block[parts[self.wide]], block[narrow]
        bounds = np.arange(block.max() + 2)
        self._wide_bounds = np.searchsorted(np.sort(wide_block), bounds)
        self._narrow_bounds = np.searchsorted(np.sort(narrow_block), bounds)
        slots: list[Codes] = [np.zeros(0, dtype=np.int64)] * len(codes)
        slots[self.wide] = _rank(wide_block)
        ranks, at = self.q_wide + _rank(narrow_block), 0
        for k in self._narrow:
            slots[k] = ranks[at : at + self.levels[k]]
            at += self.levels[k]
        return slots

    def _index_cells(self) -> None:
        """Compute the cell in the flat cross tables for each row and narrow grouping."""
        wide, narrow = np.diff(self._wide_bounds), np.diff(self._narrow_bounds)
        self._shapes = list(zip(wide.tolist(), narrow.tolist(), strict=True))
        self._cross_starts = np.cumsum([0, *(wide * narrow)])
        self._narrow_starts = np.cumsum([0, *(narrow * narrow)])
        if max(self._cross_starts[-1], self._narrow_starts[-1]) > MOST_CELLS:
            raise BadInputError(
                f"groups of {' and '.join(map(str, self.levels))} levels are too many to cross; "
                "fit one scenario at a time, or leave a group out"
            )
        row_wide = self.rows[self.wide]
        block = np.searchsorted(self._wide_bounds, row_wide, side="right") - 1
        local_wide = row_wide - self._wide_bounds[block]
        local = {k: self.rows[k] - self.q_wide - self._narrow_bounds[block] for k in self._narrow}
        width = narrow[block]
        self.cells = {
            k: self._cross_starts[block] + local_wide * width + local[k] for k in self._narrow
        }
        self.pairs = {
            (k, m): self._narrow_starts[block] + local[k] * width + local[m]
            for i, k in enumerate(self._narrow)
            for m in self._narrow[i:]
        }

    def _split(self, flat: Array, starts: Codes, square: bool) -> list[Array]:
        return [
            flat[a:b].reshape(e if square else d, e)
            for a, b, (d, e) in zip(starts[:-1], starts[1:], self._shapes, strict=True)
        ]

    def counts(self, weights: Array | None = None) -> Counts:
        """Return Z'WZ for weights of shape (n,), or weights of one."""
        squared = self._weighted(weights, self.wide, self.wide)
        wide = np.bincount(self.rows[self.wide], squared, self.q_wide).astype(np.float64)
        cross = np.zeros(self._cross_starts[-1])
        for k, cells in self.cells.items():
            cross += np.bincount(cells, self._weighted(weights, self.wide, k), len(cross))
        flat = np.zeros(self._narrow_starts[-1])
        for (k, m), pairs in self.pairs.items():
            products = self._weighted(weights, k, m)
            one = np.bincount(pairs, products, len(flat)).astype(np.float64)
            flat += one
            if k != m:
                blocks = self._split(one, self._narrow_starts, square=True)
                flat += np.concatenate([block.T.ravel() for block in blocks])
        return Counts(
            wide,
            self._split(cross, self._cross_starts, square=False),
            self._split(flat, self._narrow_starts, square=True),
        )

    def sums(self, values: Array) -> Array:
        """Return Z' times ``values`` (n,) or (n, p): sums by slot, shape (q,) or (q, p)."""
        if values.ndim == 2:
            return np.stack([self.sums(column) for column in values.T], axis=1)
        total = np.zeros(self.q)
        for k, rows in enumerate(self.rows):
            total += np.bincount(rows, self._weighted(values, k), self.q)
        return total

    def spread(self, effects: Array) -> Array:
        """Return Z times ``effects`` (q,): values by row (n,)."""
        total = self.entries(0, effects)
        for k in range(1, len(self.rows)):
            total = total + self.entries(k, effects)
        return total

    def by_grouping(self, values: Array) -> Array:
        """Return the sums of ``values`` (q,) over the levels of each grouping."""
        return np.asarray(np.bincount(self.owner, values, len(self.levels)), dtype=np.float64)

    def multiply(self, counts: Counts, effects: Array) -> Array:
        """Return Z'WZ times ``effects`` (q,) or (q, p)."""
        product = np.empty_like(effects)
        for (wide, narrow), cross, square in self.blocks(counts):
            x, y = effects[wide], effects[narrow]
            product[wide] = (counts.wide[wide] * x.T).T + cross @ y
            product[narrow] = cross.T @ x + square @ y
        return product

    def blocks(self, counts: Counts) -> list[tuple[tuple[slice, slice], Array, Array]]:
        """Return for each block its slots (wide, narrow) and its two tables."""
        wide = [slice(a, b) for a, b in _pairs(self._wide_bounds)]
        narrow = [slice(self.q_wide + a, self.q_wide + b) for a, b in _pairs(self._narrow_bounds)]
        slots_of_blocks = list(zip(wide, narrow, strict=True))
        return list(zip(slots_of_blocks, counts.cross, counts.narrow, strict=True))


def _rank(block: Codes) -> Codes:
    """Return the position of each level when levels are sorted by block."""
    position = np.empty(len(block), dtype=np.int64)
    position[np.argsort(block, kind="stable")] = np.arange(len(block))
    return position


def _pairs(bounds: Codes) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for a, b in pairwise(bounds)]
