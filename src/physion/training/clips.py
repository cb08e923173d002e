"""Clips of a dataset one by one, as torch's ``DataLoader`` takes them. This module needs no torch.

`physion.trials.dataset.Dataset.clips` makes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from physion.errors import BadInputError
from physion.models.batch import PIXELS, Spec
from physion.training.sources.open_source import observed_source, whole_source

if TYPE_CHECKING:
    from physion.trials.dataset import Dataset


class Clips(Sequence[dict[str, Any]]):
    """Clips with labels, one for each trial; see `Dataset.clips` for parameters and items.

    Clips without a future are read from the observed movies, and motions that are cut when they
    are read. Files are opened when a clip is asked for, in the process that asks.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        split: str | None = None,
        scenario: str | None = None,
        context: int = 7,
        future: int = 18,
        stride: int = 6,
        anchor: Literal["start", "end"] = "start",
        size: int = 224,
        passes: Sequence[str] = ("rgb",),
        look: str | None = None,
        objects: int = 10,
        padding: bool = True,
        labels: bool = True,
        rendered: bool = False,
    ) -> None:
        unknown = [name for name in passes if name not in PIXELS]
        if unknown or not passes:
            raise BadInputError(
                f"clips: passes must be some of {', '.join(PIXELS)}, not {list(passes)}"
            )
        self.spec = Spec(
            inputs=tuple(passes),
            image_size=size,
            stride=stride,
            context=context,
            future=future,
            anchor=anchor,
            objects=objects,
        )
        index = dataset.index.set_index("trial")
        self.trials = tuple(dataset.trials(split, scenario))
        if not padding:
            column = "frames" if future else "observed_frames"
            long = index[column] > self.spec.all_frames()[-1]
            self.trials = tuple(trial for trial in self.trials if long[trial])
        if not self.trials:
            raise BadInputError(
                f"{dataset.folder} has no trial of split {split or 'any'} and scenario "
                f"{scenario or 'any'}" + ("" if padding else " that is as long as a clip")
            )
        self._labels = index["contact"].astype(bool).to_dict() if labels else None
        self._dataset, self._look, self._rendered = dataset, look, rendered
        self._source = self._open()

    def __len__(self) -> int:
        return len(self.trials)

    def __getitem__(self, index: Any) -> Any:
        """Return the clip with this number as a dictionary of arrays; several for a slice."""
        if isinstance(index, slice):
            return [self[row] for row in range(*index.indices(len(self)))]
        trial = self.trials[index]
        read = self._source.whole if self.spec.future else self._source.context
        item: dict[str, Any] = {name: a[0] for name, a in read([trial]).arrays().items()}
        if self._labels is not None:
            item["label"] = np.bool_(self._labels[trial])
        return {**item, "trial": trial}

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[row] for row in range(len(self)))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the source: another process opens files itself."""
        return {name: value for name, value in vars(self).items() if name != "_source"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._source = self._open()

    def _open(self) -> Any:
        open_source = whole_source if self.spec.future else observed_source
        return open_source(self._dataset, self.spec, look=self._look, rendered=self._rendered)
